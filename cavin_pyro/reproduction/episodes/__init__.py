"""Single episodes of a reproduction: some of them replayed and pictured, and why the others fail, counted."""
