# SPDX-License-Identifier: Apache-2.0
"""The viewer: messages of the stream in, a web page out; a process of its own that the road never waits for."""
