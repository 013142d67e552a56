# SPDX-License-Identifier: Apache-2.0
"""What cleans and judges the frames of a run, one file each.

A filter is a `FrameFilter` in a module of this folder; `FilterChain.make_all` finds it there, `make_for_rig`
if its `in_rigs` says so. Its class is `@savable`, see `system.savable`. Nothing else has to know it.
"""
