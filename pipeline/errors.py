"""What can be wrong with a log, a file or a site, and the exit code that says so.

A `PipelineError` means that the input is at fault: the command line prints its one sentence and
ends with its exit code. Anything else that is raised is a defect of ours and keeps its traceback.
"""

from __future__ import annotations

EXIT_OK = 0
EXIT_USAGE = 2
EXIT_BAD_INPUT = 3
EXIT_VERDICT_FAIL = 4
EXIT_PARTIAL_LOG = 5


class PipelineError(Exception):
    """The input is at fault; the message is one clear sentence that says what to do."""

    exit_code = EXIT_BAD_INPUT


class UsageError(PipelineError):
    """The command was called in a way that cannot work."""

    exit_code = EXIT_USAGE


class LogError(PipelineError):
    """The log cannot be read, or lacks what the job needs."""


class ConfigError(PipelineError):
    """machine.toml or site.toml is at fault; the message names file, line and key."""


class DetectionError(PipelineError):
    """Frames cannot be decoded or searched."""


class NetworkError(PipelineError):
    """The camera-marker network cannot be built, or is not tied to the datum."""


class EstimationError(PipelineError):
    """The adjustment has no usable answer for this log."""


class CalibrationError(PipelineError):
    """A log or a survey cannot tell what it was to calibrate."""


class PlanningError(PipelineError):
    """The accuracy of this set-up cannot be planned from what its files say."""


class SurfaceError(PipelineError):
    """The design, the alignment or the check shots cannot be used."""


class ArtefactError(PipelineError):
    """A file of the run folder is missing, damaged or of another version."""
