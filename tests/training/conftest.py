"""Fixtures of trainings: the loop alone, and runs of both stages."""

from small_stages import after_stage_1, run_in, trained  # noqa: F401
from small_training import profile_of, quiet_torch, run, triplets, whole, whole_and_log  # noqa: F401
