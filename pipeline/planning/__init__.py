"""How well a set-up will measure, before anything is measured (section 3.3.2 of the paper).

The covariance of eq. (3) depends on where things stand, not on what was measured: the normal matrix of the adjustment
can be made for any posture of the machine from the two files alone. The paper does so for one camera and one marker and
takes its calibration as exact; here it is done for the whole network of a job, with every prior the files state.
"""
