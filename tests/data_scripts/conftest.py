"""The scripts are no installed package: tests find them in the repository, and the server of the downloads' tests beside those."""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1] / "data")]
