"""What a machine file needs, told from logs made for it: lenses, camera clusters, mounts, axes, benchmarks, drift."""
