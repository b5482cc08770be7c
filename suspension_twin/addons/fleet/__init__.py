# SPDX-License-Identifier: Apache-2.0
"""Many vehicles and drives: a manifest, work over Dask that can be resumed, results as Parquet, changes over time."""
