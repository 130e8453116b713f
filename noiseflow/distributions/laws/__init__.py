"""The distributions of detectors, each in closed form or exact to a stated error."""
