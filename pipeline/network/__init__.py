"""The camera-marker network of a machine on a site: what hangs on what, what was seen, where it starts.

After §3.1.1 of the paper. ``model`` holds the nouns, ``build`` makes them from the two TOML files, ``frames``
is the tree of frames with its paths, ``datum`` ties every moving body to the survey (or says in words why
it cannot), ``planar`` turns one marker in one frame into its two possible poses, ``views`` holds them by camera and
marker, ``branches`` chooses among them over time, ``resection`` refines them, ``pairs`` parts two joints that are seen
only together, ``start`` grows from the datum outwards. ``graph`` tells what is tied to what, ``sketch`` draws it.
The adjustment itself lives in ``pipeline.estimation``.
"""

from pipeline.network.build import network_of
from pipeline.network.model import Network, Observations, Readings

__all__ = ["Network", "Observations", "Readings", "network_of"]
