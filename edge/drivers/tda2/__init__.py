# SPDX-License-Identifier: Apache-2.0
"""Host of TI's cascade capture board (MMWCAS-DSP-EVM, processor TDA2) and the four radar chips behind it."""
