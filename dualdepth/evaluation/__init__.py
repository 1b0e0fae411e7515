"""Protocols and measures; knows nothing of networks."""
