# SPDX-License-Identifier: Apache-2.0
"""The appliance as a service: what it tells systemd and who measures it."""
