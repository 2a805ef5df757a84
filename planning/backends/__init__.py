"""How planning's inner functions run: eager or compiled, and many environments in chunks.

`eager` calls them as they are written. `compiled` exports each one to a graph (`torch.export`), rewrites what native
code needs otherwise (`passes`), and lets torch's Inductor write the code. Models, priors, rewards and planners know of
neither.
"""
