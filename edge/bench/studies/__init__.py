# SPDX-License-Identifier: Apache-2.0
"""Measurements behind the defaults of the signal path, each a command that prints its table; nothing here runs live."""
