"""What is generated: state types, networks, priors and the Pyro model programs."""
