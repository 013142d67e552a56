# SPDX-License-Identifier: Apache-2.0
"""The JSON files of a run as typed records, a module a file. Nothing else reads or writes them.

A record holds what its file says: fields that a file of an older version lacks have their defaults and are not written
again, fields that this version does not know are kept.
"""
