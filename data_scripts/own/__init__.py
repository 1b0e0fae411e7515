"""A data set of a user's own camera: its intrinsics, what its film shows, and the files that the chain reads."""
