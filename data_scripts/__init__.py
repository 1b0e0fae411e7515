"""Scripts that get or make data; each runs from the shell and is called by a notebook."""
