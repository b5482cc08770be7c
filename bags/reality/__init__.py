# SPDX-License-Identifier: Apache-2.0
"""An independent reality for the bundled drives: a MuJoCo car on a surface, driven and measured.

Nothing here knows the package's models: the multibody mechanics are MuJoCo's, and tyres,
driver, sensors and surfaces are written for this folder alone.
"""
