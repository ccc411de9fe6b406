"""Tests of Gymnasium's MuJoCo tasks."""
