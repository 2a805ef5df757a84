"""Our additions to Algorithm 1, one file each; None, false or 0 turns each of them off."""
