# SPDX-License-Identifier: Apache-2.0
"""Association of both radars, accumulation over travel, objects."""
