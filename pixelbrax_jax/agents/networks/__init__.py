"""Agents' networks and the distributions of their actions."""
