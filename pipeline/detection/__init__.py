"""Frame -> marker corners with a covariance: decode, find, judge, and work through a log in slices."""
