"""State types, networks, priors and the Pyro model programs."""
