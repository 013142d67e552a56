# SPDX-License-Identifier: Apache-2.0
"""Larger generated scenes, loaded when one is asked for: a ring of rooms and corridors, and a long corridor."""
