# SPDX-License-Identifier: Apache-2.0
"""Mesh readers and parametric generators."""
