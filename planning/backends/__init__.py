"""How planning's inner functions run: eager or compiled, and many environments in chunks.

`eager` calls them as they are. `compiled` exports each one to a graph (`torch.export`), rewrites the graph for fast
native code (`passes`), and compiles it with torch's Inductor. Models, priors, rewards and planners do not depend on
either.
"""
