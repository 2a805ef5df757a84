"""The paper's experiments from scratch: stages, cells, table of episodes, statistics and figures."""
