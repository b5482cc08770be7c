# SPDX-License-Identifier: Apache-2.0
"""What targets share that carry the equations of a model away: kernels written out in another language."""
