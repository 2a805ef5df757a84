"""Closed-loop episodes: rollout, evaluation over seeds, comparison, statistics of rates."""
