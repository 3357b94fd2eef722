# SPDX-License-Identifier: Apache-2.0
"""The training workstation: objects, simulation, network, training, export."""
