"""The two files that describe a job: `machine.toml` (one excavator) and `site.toml` (one site).

Everything calibrated or surveyed carries its standard deviation or covariance. Lengths in
machine.toml are metres, coordinates in site.toml are in the site's own grid unit; angles are
degrees and sigmas millimetres or degrees, because people write these files. Inside the house
everything is metres and radians: the models convert, nobody else does.
"""

from pipeline.config.document import load_machine, load_site
from pipeline.config.machine import Machine
from pipeline.config.site import Site

__all__ = ["Machine", "Site", "load_machine", "load_site"]
