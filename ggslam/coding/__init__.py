# SPDX-License-Identifier: Apache-2.0
"""Point clouds as MPEG G-PCC streams (ISO/IEC 23090-9, first edition), coded in parallel slices."""

from ggslam.coding.cloud import CodingReport, EncodedCloud, PointCloud, SliceReport
from ggslam.coding.decoder import SliceInfo, decode_box, decode_cloud, decode_slice, list_slices
from ggslam.coding.encoder import encode_cloud
from ggslam.coding.settings import AttributeSettings, CodecSettings

__all__ = [
    "AttributeSettings",
    "CodecSettings",
    "CodingReport",
    "EncodedCloud",
    "PointCloud",
    "SliceInfo",
    "SliceReport",
    "decode_box",
    "decode_cloud",
    "decode_slice",
    "encode_cloud",
    "list_slices",
]
