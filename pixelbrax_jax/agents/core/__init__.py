"""What algorithms are made of: networks, rollouts, returns, losses."""
