"""What all tests share."""

from __future__ import annotations

from hypothesis import settings

# Other processes may hold the machine up: how long an example takes says nothing.
settings.register_profile("cavin_pyro", deadline=None)
settings.load_profile("cavin_pyro")
