# SPDX-License-Identifier: Apache-2.0
"""Types of messages and services, and their hashes."""

from __future__ import annotations

import pytest

from ggslam.errors import MiddlewareError
from ggslam.middleware.definitions import MESSAGES, SERVICES
from ggslam.middleware.types import DISTRIBUTIONS, MessageTypes, message_types

pytest.importorskip("rosbags")

PUBLIC_HASHES = {
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "std_srvs/srv/Trigger": "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "std_srvs/srv/Trigger_Request": "RIHS01_d010825374ce8918e72bfd826c82603e60f45419e932ea976f807b74a863a199",
    "std_srvs/srv/SetBool": "RIHS01_abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
    "std_srvs/srv/SetBool_Response": "RIHS01_d0814e7f7b4880ab77e9c57426c7aa1562ab69f11eef8e2e968812f9cbd0b059",
    "std_srvs/srv/Empty": "RIHS01_5888399dedec5ccc85ea6451949fd2c9f97bfdf963f9a588821639fcd31b5d19",
    "example_interfaces/srv/AddTwoInts": "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
}
"""As ROS 2 jazzy prints them (documentation of rmw_zenoh, and lists that users have published)."""


@pytest.mark.parametrize("kind", PUBLIC_HASHES)
def test_hashes_are_those_of_ros(kind: str) -> None:
    types = message_types("jazzy")
    types.register_service("example_interfaces/srv/AddTwoInts", "int64 a\nint64 b\n", "int64 sum\n")
    assert types.hash(kind) == PUBLIC_HASHES[kind]


def test_hashes_of_messages_agree_with_rosbags() -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types = message_types("jazzy")
    with_char = {"rmw_dds_common", "service_msgs"}  # rosbags takes char for that of IDL
    kinds = [kind for kind in store.types if kind.split("/")[0] not in with_char and kind != "std_msgs/msg/Char"]
    differ = [kind for kind in kinds if store.hash_rihs01(kind) != types.hash(kind)]
    assert len(kinds) > 100 and differ == []


def test_services_have_requests_and_responses() -> None:
    types = message_types("jazzy")
    request = types.make("std_srvs/srv/Trigger_Request")
    assert types.encode("std_srvs/srv/Trigger_Request", request) == b"\0\1\0\0\0"
    response = types.make("std_srvs/srv/Trigger_Response", success=True, message="so")
    content = types.encode("std_srvs/srv/Trigger_Response", response)
    assert types.decode("std_srvs/srv/Trigger_Response", content) == response
    assert [name for name, _ in types.fields("nav_msgs/srv/GetPlan_Request")] == ["start", "goal", "tolerance"]


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_all_distributions_have_what_is_used(distribution: str) -> None:
    types = message_types(distribution)
    for kind in (*MESSAGES, *SERVICES):
        assert types.hash(kind)
    for kind in ("rmw_dds_common/msg/ParticipantEntitiesInfo", "tf2_msgs/msg/TFMessage"):
        assert types.fields(kind)


def test_own_definitions() -> None:
    types = MessageTypes("jazzy")
    types.register_service("ggslam_msgs/srv/Distance", "geometry_msgs/Point[] points\n", "float32[] distances # m\n")
    types.register_service("ggslam_msgs/srv/Nothing", "# only a remark\nint32 A=1\n", "string<=5 text\n")
    assert types.hash("ggslam_msgs/srv/Distance").startswith("RIHS01_")
    assert types.encode("ggslam_msgs/srv/Nothing_Request", types.make("ggslam_msgs/srv/Nothing_Request"))
    for kind, text in (("Distance", "int32 a"), ("a/msg/B", "what is this"), ("a/msg/C", "int32[ x")):
        with pytest.raises(MiddlewareError):
            types.register({kind: text})


def test_humble_has_no_hashes() -> None:
    assert message_types("humble").hash("std_srvs/srv/Trigger") == "TypeHashNotSupported"
    with pytest.raises(MiddlewareError, match="expected a distribution"):
        message_types("groovy")


def test_unknown_types_are_named() -> None:
    types = message_types("jazzy")
    for action in (types.make, types.hash, types.fields, lambda kind: types.decode(kind, b"")):
        with pytest.raises(MiddlewareError, match="x_msgs/msg/X"):
            action("x_msgs/msg/X")
