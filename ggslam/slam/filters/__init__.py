# SPDX-License-Identifier: Apache-2.0
"""What cleans and judges the frames of a run, one file each.

A filter is a `FrameFilter` in a module of this folder; `FilterChain.make` finds it there. Nothing else has to know it.
"""
