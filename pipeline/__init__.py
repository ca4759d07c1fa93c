"""From the log of an excavator's cameras to poses with honest covariances and a trench report."""

__version__ = "0.1.0.dev0"
