"""A machine and a site as people would write them, small and whole."""

import pytest

MACHINE = """\
format = "gradetrace/machine/1"

[machine]
id = "EX-1"

[bodies.cab]
kind = "moving"

[bodies.stick]
kind = "moving"

[bodies.bucket]
kind = "joint"
parent = "stick"
axis = { xyz_m = [0.0, 0.1, 2.0], rpy_deg = [0, 90, 0], sigma_mm = 1.0, sigma_deg = 0.1 }

[cameras.front]
topic = "/front"
body = "cab"

[cameras.front.mount]
xyz_m = [0.5, 0.0, 1.5]
rpy_deg = [-90, 0, 0]
sigma_mm = [1.0, 1.0, 2.0]
sigma_deg = 0.05

[cameras.front.intrinsics]
width = 640
height = 480
fx = 850.0
fy = 850.0
cx = 319.5
cy = 239.5
sigma = [1, 1, 1, 1, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3]

[markers.plate]
body = "stick"
family = "tag36h11"
tags = [
  { id = 1, size_m = 0.2, x_m = -0.15 },
  { id = 2, size_m = 0.2, x_m = 0.15 },
]

[markers.plate.mount]
xyz_m = [0, 0, 0]
rpy_deg = [0, 0, 0]
sigma_mm = 0.5
sigma_deg = 0.02

[sensors.pot]
topic = "/pot"
joint = "bucket"
noise = 0.002

[sensors.pot.curve]
output = "angle_deg"
coefficients = [-90.0, 36.0]
sigma = [0.2, 0.01]

[cutting_edge]
body = "bucket"
width_m = 0.9
mount = { xyz_m = [0, 0, 0.8], rpy_deg = [0, 0, 0], sigma_mm = 2, sigma_deg = 0.2 }
"""

SITE = """\
format = "gradetrace/site/1"

[site]
id = "TRENCH-7"

[grid]
unit = "m"
origin = [1000, 2000, 50]

[benchmarks.bm1]
family = "tag36h11"
tags = [{ id = 10, size_m = 0.3 }]

[benchmarks.bm1.pose]
enh = [1003.5, 2010.25, 51.2]
rpy_deg = [90, 0, 180]
sigma_mm = 2.0
sigma_deg = 0.1

[benchmarks.bm2]
family = "tag36h11"
sigma_corner_mm = 1.5
tags = [{ id = 11, size_m = 0.3 }]

[[benchmarks.bm2.corners]]
tag = 11
corner = 0
enh = [1001, 2012, 51]

[[benchmarks.bm2.corners]]
tag = 11
corner = 1
enh = [1001.3, 2012, 51]

[[benchmarks.bm2.corners]]
tag = 11
corner = 2
enh = [1001.3, 2012, 50.7]

[alignment]
points = [[1000, 2000], [1000, 2020]]

[design]
file = "design.csv"
kind = "profile_csv"

[tolerance]
high_mm = 25
low_mm = 25
"""


@pytest.fixture
def machine_text():
    return MACHINE


@pytest.fixture
def site_text():
    return SITE
