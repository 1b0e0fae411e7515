"""Training: one optimisation step (`stages`), the loop (`loop`), checkpoints, weights with their cards, and what a variant trains."""
