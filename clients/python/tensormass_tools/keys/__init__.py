"""`tensormass keys`: makes, renews and removes the keys of daemons and their clients."""
