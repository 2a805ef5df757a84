"""Real meshes from their publishers' sites, made into folders that the simulator can use."""
