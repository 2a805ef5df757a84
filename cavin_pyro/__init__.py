"""The CAVIN planner (Fang et al., CoRL 2019) as modular probabilistic programs: the commands and what they need."""

__version__ = "0.2.0"
