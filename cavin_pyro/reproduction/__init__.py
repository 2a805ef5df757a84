"""The paper's experiments from nothing: stages, cells, table of episodes, statistics and figures."""
