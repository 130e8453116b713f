"""Outputs of runs: checked, locked, written beside their target and renamed, marked as ours; and the states that resume a run."""
