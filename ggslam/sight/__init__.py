# SPDX-License-Identifier: Apache-2.0
"""Does a view look through a place? One margin from the depth noise, and one compiled answer."""
