"""The adjustment: every observation of a log at once, with the states, the statics and their covariances.

``adjust`` is the front door. ``problem`` sorts the measurements into groups of one path and chains of states,
``residuals`` and ``motion`` hold eq. (1) and its derivatives, ``arrow`` the linear algebra, ``optimise`` the
iterations, ``pull`` what the motion prior must not say of the statics, ``marginals`` eq. (3) with its own and common
part, ``diagnostics`` what a surveyor asks first. The equations with their symbols are in ``docs/equations.md``.
"""

from pipeline.estimation.adjust import adjust
from pipeline.estimation.solution import Solution

__all__ = ["Solution", "adjust"]
