# SPDX-License-Identifier: Apache-2.0
"""DCA1000 capture card: commands, reception of samples, assembly of frames."""

from edge import numba_cache

numba_cache.enable()
