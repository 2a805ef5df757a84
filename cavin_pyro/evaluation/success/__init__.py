"""The probability that an episode succeeds, given its plans: what they tell, the fitted model, and its calibration."""
