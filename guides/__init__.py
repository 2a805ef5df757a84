"""What is inferred: inference networks and the Pyro guide programs."""
