"""The paper's tables beside ours: published rows with `source` paper, our own with `source` measured."""
