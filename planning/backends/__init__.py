"""How planning's inner functions run: eager, compiled or as CUDA graphs, and many environments in chunks.

`eager` calls them as they are. `compiled` exports each one to a graph (`torch.export`), rewrites the graph for fast
native code (`passes`), and compiles it with torch's Inductor. `cuda_graphs` captures them on a GPU. Models, priors,
rewards and planners do not depend on any of these.
"""
