# SPDX-License-Identifier: Apache-2.0
"""Recordings of kitchens with exact depth, poses and instance masks, drawn by MuJoCo from the models of LIBERO.

Liu et al., "LIBERO: Benchmarking Knowledge Transfer for Lifelong Robot Learning", NeurIPS 2023. Some ten things stand
on an island of wood or marble, before a counter with a stove, a pot and a kettle. Objects without masks are scored on
them, see docs/objects.md.

    pip install mujoco
    MUJOCO_GL=egl python scripts/tools/make_kitchens.py --assets LIBERO/libero/libero/assets --out kitchens --seeds 0 1

Neither is needed for anything else. Models that are incomplete are left out and named (MuJoCo 4 refuses
`flat_stove.xml` until one of two textures of one name is renamed); counter and cupboards are boxes.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

import cv2
import mujoco
import numpy as np

WIDTH, HEIGHT, FOCAL = 640, 480, 415.692194
ISLAND = 0.5, 0.6
"""Half of its length and width, metres."""
TOP = 0.8
LARGE = {
    "articulated_objects/flat_stove": 0.21, "articulated_objects/microwave": 0.24,
    "articulated_objects/white_cabinet": 0.23, "articulated_objects/wooden_cabinet": 0.23,
    "turbosquid_objects/wine_rack/wine_rack": 0.24, "turbosquid_objects/moka_pot/moka_pot": 0.1,
    "turbosquid_objects/wine_bottle/wine_bottle": 0.06, "turbosquid_objects/black_book/black_book": 0.09,
    "turbosquid_objects/yellow_book/yellow_book": 0.09,
    "stable_scanned_objects/chefmate_8_frypan/chefmate_8_frypan": 0.22,
    "stable_scanned_objects/glazed_rim_porcelain_ramekin/glazed_rim_porcelain_ramekin": 0.08,
    "turbosquid_objects/wooden_tray/wooden_tray": 0.24, "turbosquid_objects/bowl_drainer/bowl_drainer": 0.21,
    "turbosquid_objects/wooden_two_layer_shelf/wooden_two_layer_shelf": 0.25,
}  # fmt: skip
"""Models and the radius of the room that each gets on the island, metres."""
SMALL = (
    "alphabet_soup", "bbq_sauce", "butter", "chocolate_pudding", "cookies", "cream_cheese", "ketchup",
    "macaroni_and_cheese", "milk", "new_salad_dressing", "orange_juice", "popcorn", "salad_dressing",
)  # fmt: skip
SMALL_RADIUS = 0.085
WOOD_AND_STONE = "martin_novak_wood_table", "table_light_wood", "marble_floor", "white_marble_floor"
CUPBOARDS = (
    ((-1.65, 0, 0.42), (0.3, 1.6, 0.42), (0.35, 0.25, 0.2)),
    ((-1.63, 0, 0.86), (0.34, 1.62, 0.02), (0.75, 0.73, 0.7)),
    ((-1.82, 0, 1.75), (0.17, 1.6, 0.35), (0.35, 0.25, 0.2)),
)
"""Centre, half size and colour of each box."""
KITCHEN_LIGHT = -0.1, -0.06, -1.0
"""Where the room's distant light shines. LIBERO's shines straight down, along every upright face: rounding then decides
frame by frame whether a face is lit and gets the light's specular share, and whole faces flicker. Leaned like this it
lights fronts that the lamp above the island lights anyway."""
PATHS = {"first": (0.0, 0.0, 0.0), "other": (np.radians(20), 0.15, 0.3)}
"""What each path adds to the camera's angle about the island, radians, to its distance and to its height, metres."""


def read_room(assets: Path, top: str) -> mujoco.MjSpec:
    """The room with its island of a material, without things."""
    xml = (assets / "scenes" / "libero_kitchen_tabletop_base_style.xml").read_text()
    xml = xml.replace('file="../textures', f'file="{assets}/textures')
    xml = re.sub(r'file="(kitchen|fridge)', lambda match: f'file="{assets}/scenes/{match[1]}', xml)
    for part, mesh in (
        ("_stove/visual/kitchen_background_stove_vis.msh", "_stove/collision/kitchen_background_stove_ch.stl"),
        ("/visual/kitchen_background_vis.msh", "/collision/kitchen_background_ch.stl"),
        ("_pot/visual/kitchen_background_pot_vis.msh", "_pot/kitchen_background_pot.obj"),
    ):
        xml = xml.replace(f"kitchen_background{part}", f"kitchen_background{mesh}")
    wood = 'textures/martin_novak_wood_table.png" type="cube" name="tex-table"'
    spec = mujoco.MjSpec.from_string(xml.replace(wood, f'textures/{top}.png" type="2d" name="tex-table"'))
    for geom in list(spec.geoms):
        if geom.meshname == "kitchen_background_vis":
            spec.delete(geom)
        elif geom.name in ("table_visual", "table_collision"):
            geom.size = [*ISLAND, TOP / 2]
        elif geom.name.startswith("table_leg"):
            geom.pos = [0, 0, -TOP / 4]
    spec.light("light_kitchen").dir = KITCHEN_LIGHT
    for number, (centre, size, color) in enumerate(CUPBOARDS):
        spec.worldbody.add_geom(
            name=f"cupboard{number}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=list(centre), size=list(size),
            rgba=[*color, 1], contype=0, conaffinity=0, group=1,
        )  # fmt: skip
    return spec


def place_things(spec: mujoco.MjSpec, assets: Path, rng: np.random.Generator, stove: bool) -> dict[str, str]:
    """Puts things on the island where there is room; models by name."""
    large, small = list(LARGE), [f"stable_hope_objects/{name}/{name}" for name in SMALL]
    chosen = [large[i] for i in rng.permutation(len(large))[:5]] + [small[i] for i in rng.permutation(len(small))[:6]]
    if stove and large[0] not in chosen:
        chosen[0] = large[0]
    placed: list[tuple[float, float, float]] = []
    names: dict[str, str] = {}
    for model in sorted(chosen, key=lambda model: -LARGE.get(model, SMALL_RADIUS)):
        radius, file = LARGE.get(model, SMALL_RADIUS), str(assets / f"{model}.xml")
        try:
            mujoco.MjSpec.from_file(file).compile()
        except ValueError as error:
            print(f"left out: {model}: {str(error).splitlines()[0]}")
            continue
        for _ in range(3000):
            x, y = (rng.uniform(-half + radius, half - radius) for half in ISLAND)
            if all(np.hypot(x - a, y - b) > radius + other for a, b, other in placed):
                break
        else:
            print(f"no room for {model}")
            continue
        placed.append((x, y, radius))
        name, angle = f"o{len(names)}", rng.uniform(0, 6.28)
        frame = spec.worldbody.add_frame(pos=[x, y, TOP], quat=[np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
        thing = mujoco.MjSpec.from_file(file)
        thing.modelname = name
        drop_doubles(thing)
        spec.attach(thing, frame=frame, prefix=f"{name}/")
        names[name] = model.rsplit("/", 1)[-1]
    return names


def drop_doubles(thing: mujoco.MjSpec) -> None:
    """Takes away meshes that a model draws a second time at the same place, so that no two seen surfaces coincide."""
    seen = set()
    for geom in list(thing.geoms):
        kind = geom.parent.name, geom.group, geom.meshname, *geom.pos, *geom.quat
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and kind in seen:
            thing.delete(geom)
        seen.add(kind)


def name_geoms(model: mujoco.MjModel) -> list[str]:
    """What each geom is a part of."""
    found = []
    for geom in range(model.ngeom):
        body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, model.geom_bodyid[geom]) or ""
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or ""
        if "/" in body:
            found.append(f"obj:{body.split('/')[0]}")
        elif body == "table" or name.startswith("cupboard"):
            found.append("scene:table" if body == "table" else "scene:kitchen_background")
        else:
            name = name or mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_MESH, model.geom_dataid[geom])
            found.append(f"scene:{name}")
    return found


def settle_things(model: mujoco.MjModel, data: mujoco.MjData, owners: list[str]) -> None:
    """Raises or lowers things until they stand on the island."""
    for body in range(model.nbody):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) or ""
        if "/" not in name or model.body_parentid[body]:
            continue
        thing = f"obj:{name.split('/')[0]}"
        parts = [g for g, owner in enumerate(owners) if owner == thing and model.geom_group[g]]
        lowest = min(float(_corners(model, data, geom)[:, 2].min()) for geom in parts)
        model.body_pos[body, 2] += TOP + 0.0005 - lowest


def _corners(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Vertices of a mesh, or corners of the box about any other shape, world [N, 3]."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        begin = model.mesh_vertadr[mesh]
        local = model.mesh_vert[begin : begin + model.mesh_vertnum[mesh]]
    else:
        size = model.geom_size[geom]
        local = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3) * np.where(size > 0, size, size[0])
    return local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def camera_pose(turn: float, start: float, path: str) -> np.ndarray:
    """T_world_camera [4, 4] (x right, y down, z ahead) of a hand-held walk about the island; a turn is 200 frames."""
    u, (further, farther, higher) = 2 * np.pi * turn, PATHS[path]
    angle = start + 1.3 * np.sin(0.9 * u) + 0.3 * np.sin(2.3 * u) + further
    radius, height = 1.15 + 0.25 * np.sin(1.3 * u + 1) + farther, 1.35 + 0.2 * np.sin(1.7 * u) + higher
    place = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
    ahead = np.array([0.15 * np.sin(1.1 * u) - 0.3, 0.2 * np.sin(1.9 * u), 0.85]) - place
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(ahead, right), ahead, place], 1)
    return pose


def make_kitchen(assets: Path, seed: int, out: Path, frames: int, path: str = "first") -> None:
    """Writes a recording in Replica's layout."""
    rng = np.random.default_rng(seed)
    spec = read_room(assets, WOOD_AND_STONE[seed % len(WOOD_AND_STONE)])
    names = place_things(spec, assets, rng, stove=seed % 2 == 0)
    spec.visual.global_.offwidth, spec.visual.global_.offheight, spec.visual.map.znear = WIDTH, HEIGHT, 0.01
    spec.worldbody.add_camera(name="camera", fovy=2 * np.degrees(np.arctan(HEIGHT / 2 / FOCAL)))
    model = spec.compile()
    data = mujoco.MjData(model)
    owners = name_geoms(model)
    ids = {name: k for k, name in enumerate(dict.fromkeys(owners), 1)}
    mujoco.mj_forward(model, data)
    settle_things(model, data, owners)
    id_of_geom = np.array([ids[name] for name in owners] + [0], np.uint16)  # the last one: no geom
    options = mujoco.MjvOption()
    options.geomgroup[:] = 0
    options.geomgroup[1] = 1
    options.sitegroup[:] = 0
    for folder in ("results", "semantic_instance"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    start, poses, camera = rng.uniform(-0.6, 0.6), [], model.camera("camera").id
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for frame in range(frames):
            pose = camera_pose(frame / 199, start, path)
            turned = np.zeros(4)
            mujoco.mju_mat2Quat(turned, (pose[:3, :3] @ np.diag([1.0, -1, -1])).ravel())
            model.cam_pos[camera], model.cam_quat[camera] = pose[:3, 3], turned
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, "camera", options)
            color = renderer.render().copy()
            renderer.enable_depth_rendering()
            depth = renderer.render().copy()
            depth[depth > 20] = 0
            renderer.disable_depth_rendering()
            renderer.enable_segmentation_rendering()
            shown = renderer.render()
            renderer.disable_segmentation_rendering()
            geom = np.where(shown[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, shown[..., 0], -1)
            images = out / "results"
            cv2.imwrite(str(images / f"frame{frame:06d}.jpg"), color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
            cv2.imwrite(str(images / f"depth{frame:06d}.png"), np.round(1000 * depth).astype(np.uint16))
            cv2.imwrite(str(out / "semantic_instance" / f"semantic_instance_{frame}.png"), id_of_geom[geom])
            poses.append(pose.ravel())
    np.savetxt(out / "traj.txt", poses, fmt="%.9g")
    lens = {"w": WIDTH, "h": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2 - 0.5, "cy": HEIGHT / 2 - 0.5}
    known = {str(k): f"{name} {names.get(name.removeprefix('obj:'), '')}".strip() for name, k in ids.items()}
    described = {"camera": {**lens, "scale": 1000.0}, "instances": known}
    (out / "cam_params.json").write_text(json.dumps(described, indent=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", type=Path, required=True, help="LIBERO's folder libero/libero/assets")
    parser.add_argument("--out", type=Path, required=True, help="folder; each kitchen becomes a recording in it")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 10, 11, 12, 13, 20, 21, 22, 23])
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--path", choices=PATHS, default="first", help="other: the same kitchens seen from elsewhere")
    arguments = parser.parse_args()
    if not (arguments.assets / "scenes").is_dir():
        parser.error(f"{arguments.assets}: no folder scenes: expected LIBERO's assets")
    for seed in arguments.seeds:
        out = arguments.out / f"kitchen{seed}"
        make_kitchen(arguments.assets.resolve(), seed, out, arguments.frames, arguments.path)
        print(f"wrote {out}")


if __name__ == "__main__":
    main()
