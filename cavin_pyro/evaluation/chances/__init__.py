"""The chance that an episode succeeds, given its plan: what plans tell, the model of it, and its calibration."""
