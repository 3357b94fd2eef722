# SPDX-License-Identifier: Apache-2.0
"""Association of both radars, accumulation over travel, objects."""

from edge import numba_cache

numba_cache.enable()
