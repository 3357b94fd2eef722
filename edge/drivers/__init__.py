# SPDX-License-Identifier: Apache-2.0
"""Drivers of the boards: sockets, serial ports and clocks; nothing here looks at a sample."""
