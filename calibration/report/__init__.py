"""The calibration's HTML report."""
