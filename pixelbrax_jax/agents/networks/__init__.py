"""Networks of agents, and the distributions of their actions."""
