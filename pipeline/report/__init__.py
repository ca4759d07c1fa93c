"""The page that a surveyor signs: figures, sections, rendering.

`render` makes one self-contained HTML text and the dict of every number on it (report.json) from the
artefacts of a run; nothing is measured again here. The page asks nothing of any network, is whole without
JavaScript, and the same artefacts give the same bytes.
"""

from pipeline.report.inputs import FileSource, ReportInputs, View
from pipeline.report.page import Page, render

__all__ = ["FileSource", "Page", "ReportInputs", "View", "render"]
