# SPDX-License-Identifier: Apache-2.0
"""Float64 definitions of the kernels and a small point-target frame maker."""
