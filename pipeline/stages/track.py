"""track: the adjusted states -> poses of all bodies and of the cutting edge in the survey grid."""

from __future__ import annotations

import numpy as np

from pipeline.errors import EstimationError
from pipeline.stages.job import Counts, Job, Progress
from pipeline.tracks import table
from pipeline.tracks.poses import TOOL, cutting_edge, grid_poses

PORTION_ROWS = 131_072


def run(job: Job, progress: Progress) -> Counts:
    """Write `poses` and `cutting_edge` at every epoch of `states`.

    Raises EstimationError when the states do not hold the cutting edge.
    """
    states = table.states_from_columns(job.read_table("states"))
    if not np.any(states.body == TOOL):
        raise EstimationError(
            "the adjustment has no state of the cutting edge: nothing ties the body that carries it to the "
            f"surveyed benchmarks (machine.toml: cutting_edge.body = '{job.machine.cutting_edge.body}'); "
            "see what 'gradetrace check' says about the ties"
        )
    origin_m = job.site.grid.to_grid_metres(np.zeros(3))
    progress.total(len(states), "states")
    with job.table_writer("poses") as writer:
        for start in range(0, len(states), PORTION_ROWS):
            portion = states.take(slice(start, start + PORTION_ROWS))
            writer.write(table.columns_of_poses(grid_poses(portion, origin_m)))
            progress.advance(len(portion))
    edge = cutting_edge(states, job.machine.cutting_edge.width_m, origin_m)
    job.write_table("cutting_edge", table.columns_of_cutting_edge(edge))
    bridged = int(np.count_nonzero(~edge.seen))
    return {"poses": len(states), "epochs of the cutting edge": len(edge), "of these bridged": bridged}
