"""The CAVIN planner (Fang et al., CoRL 2019) as modular probabilistic programs: the commands and what they need."""

import os

__version__ = "0.1.0"

# OpenMP's threads otherwise spin while they wait for one another, and a plan waits thousands of times: where another
# process has one of the cores, planning then takes up to seventy times as long. OpenMP reads this when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
