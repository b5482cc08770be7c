# SPDX-License-Identifier: Apache-2.0
"""Plans: which faults a set-up could show before anyone drives, and which it could never tell apart."""
