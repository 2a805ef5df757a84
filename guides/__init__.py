"""Inference networks and the Pyro guide programs."""
