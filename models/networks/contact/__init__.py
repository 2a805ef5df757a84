"""Where the tool meets objects and objects meet each other, and dynamics that read it."""
