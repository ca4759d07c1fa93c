"""Every network of the paper, by configuration alone: poses against truth, within their covariances."""

import numpy as np
import pytest

from pipeline.estimation import adjust
from tests.network.drawing import Course, Scene, draw

CAB = Course([0.0, 0.0, 1.5], (0.03, 1.0))
STICK = Course([1.0, 6.0, 0.3], (0.15, 6.0))
BUCKET = Course(-15.0, (0.0, 12.0))
ALWAYS = ((0.0, 1e9),)
APART = {"bench>stick_board": ALWAYS, "dig>B1": ALWAYS, "dig>B2": ALWAYS, "dig>B3": ALWAYS}
"""As in Fig. 4: one camera looks at the benchmarks, the other at the stick."""
SCENES = [
    Scene("one-camera", {"cab": CAB}),
    Scene("site-camera", {"stick": STICK}),
    Scene("third-camera", {"cab": CAB, "stick": STICK}),
    Scene("cluster", {"cab": CAB, "stick": STICK}, hidden=APART),
    Scene("flip-marker", {"cab": CAB, "stick": STICK, "bucket": BUCKET}),
    Scene(
        "flip-marker",
        {"cab": CAB, "stick": STICK, "bucket": Course(50.0, (0.0, 20.0))},
        replaced=(("ratio = 1.0", "ratio = -0.5"),),
    ),
    Scene("potentiometer", {"cab": CAB, "stick": STICK, "bucket": BUCKET}, hidden=APART),
    Scene(
        "full-chain",
        {
            "undercarriage": Course([0.0, 0.0, 0.5], (0.02, 0.5)),
            "cab": Course(0.0, (0.0, 4.0)),
            "boom": Course(40.0, (0.0, 2.0)),
            "stick": Course(-100.0, (0.0, 4.0)),
            "bucket": Course(-40.0, (0.0, 10.0)),
        },
    ),
    Scene(
        "two-machines",
        {
            "cab": CAB,
            "stick": STICK,
            "dozer": Course([5.0, 7.0, 0.8], (0.1, 2.0)),
            "tripod": Course([2.5, -1.0, 1.6]),
        },
        late_s={"site": 0.05, "dozer_eye": 0.11},
    ),
]
SEEDS = (1, 2, 3)


LONG = {"two-machines"}
"""Scenes whose draws take half a minute: left to `make test-all`."""


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(
            s,
            id=f"{s.name}-geared" if s.replaced else s.name,
            marks=[pytest.mark.slow] if s.name in LONG else [],
        )
        for s in SCENES
    ],
)
def test_poses_of_every_network_of_the_paper_lie_within_their_covariances(scene):
    whitened = {}
    for seed in SEEDS:
        drawn = draw(scene, seed)
        solution = adjust(drawn.network, drawn.observations, drawn.readings)
        assert solution.diagnostics["converged"]
        assert {s.body for s in solution.states} == set(drawn.truth)
        for states in solution.states:
            e = drawn.errors(states)
            L = np.linalg.cholesky(states.own + states.common)
            whitened.setdefault(states.body, []).append(np.linalg.solve(L, e[..., None])[..., 0])
    worst = {b: float(np.abs(np.concatenate(w)).max()) for b, w in whitened.items()}
    every = np.concatenate([np.concatenate(w) for w in whitened.values()])
    rms = float(np.sqrt(np.mean(every**2)))
    print(f"{scene.name}: RMS {rms:.2f}", {b: f"worst {x:.1f}" for b, x in worst.items()})
    assert max(worst.values()) < 5.0
    assert 0.6 < rms < 1.4
