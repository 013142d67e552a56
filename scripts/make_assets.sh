#!/bin/bash
# SPDX-License-Identifier: Apache-2.0
# Makes the pictures of README and docs anew, each from a run that is made here:
#
#   bash scripts/make_assets.sh                       all of them, into docs/pictures and assets
#   bash scripts/make_assets.sh overview points       some of them
#
# overview, points, loop, film and clip need nothing but generated recordings. editing and viewer need GGSLAM_DATA/livingroom,
# objects and volumes GGSLAM_DATA/redkitchen (7-Scenes); without GGSLAM_DATA, pictures made of these stay as they are. viewer
# needs chromium and selenium, clip Pillow. Runs are kept in GGSLAM_ASSETS (default: a folder below the temporary one) and used again.
# PICTURES and CLIPS say where the pictures go.
set -euo pipefail
cd "$(dirname "$0")/.."
work=${GGSLAM_ASSETS:-${TMPDIR:-/tmp}/ggslam_assets}
pictures=${PICTURES:-docs/pictures}
clips=${CLIPS:-assets}
python=${PYTHON:-python3}
data=${GGSLAM_DATA:-}
mkdir -p "$work" "$pictures" "$clips"

ggslam() { "$python" -m ggslam "$@"; }
sheet() { "$python" scripts/tools/make_sheet.py "$@"; }

# recording NAME ARGUMENTS...: a generated recording.
recording() { [ -d "$work/$1" ] || ggslam synth "$work/$1" "${@:2}"; }
# run NAME SEQUENCE ARGUMENTS...: a run.
run() { [ -f "$work/$1/run.json" ] || ggslam run "$2" --out "$work/$1" "${@:3}"; }
# given NAME: whether the recording is there; says so if not.
given() {
    [ -n "$data" ] && [ -d "$data/$1" ] && return
    echo "left as it is: $2 (needs GGSLAM_DATA/$1)"
    return 1
}

overview() {
    recording room && run room_run "$work/room"
    # Recorded, rendered, difference; the same of depth below.
    sheet "$pictures/overview.jpg" --width 968 --row "$work/room_run/renders/compare000000.png"
}

points() {
    recording room && run room_run "$work/room"
    local to="$work/points"
    ggslam export "$work/room_run" --format points --voxel 0.005 --out "$to/surface"
    ggslam export "$work/room_run" --format points --discs --out "$to/discs"
    "$python" scripts/tools/draw_points.py "$work/room_run" "$to/surface/points.ply" "$to/surface.png" --frame 30
    "$python" scripts/tools/draw_points.py "$work/room_run" "$to/discs/points.ply" "$to/discs.png" --frame 30
    sheet "$pictures/points.jpg" --row "$to/surface.png" "$to/discs.png" "$(recorded_frame room 30)"
}

loop() {
    recording walk --scene loop
    run walk_run "$work/walk" --no-eval && run walk_open "$work/walk" --no-loops --no-eval
    local frames last rows=() frame
    last=$("$python" -c 'import json, sys; print(json.load(open(sys.argv[1]))["frames"] - 1)' "$work/walk_run/sequence.json")
    frames=$((last - 20)),$((last - 5))
    for made in walk_run walk_open; do ggslam render "$work/$made" --frames "$frames" --what color --out "$work/$made/loop"; done
    for frame in ${frames//,/ }; do
        name=$(printf 'frame%06d_color.png' "$frame")
        rows+=(--row "$(recorded_frame walk "$frame")" "$work/walk_open/loop/$name" "$work/walk_run/loop/$name")
    done
    sheet "$pictures/loop.jpg" "${rows[@]}"
}

editing() {
    given livingroom editing.jpg || return 0
    run living_run "$data/livingroom"
    ggslam edit "$work/living_run" --remove obj:o8 --move obj:o5 "0.2 0.05 -0.15" --duplicate obj:o9 "-0.45 0 0" \
        --recolor obj:o6 "#2060c0" --rename obj:o7 bottle --inpaint --out "$work/living_edited" --overwrite
    local rows=() frame name
    for frame in 0 48; do
        name=$(printf 'frame%06d_color.png' "$frame")
        ggslam render "$work/living_run" --frames "$frame" --what color --out "$work/editing/before"
        ggslam render "$work/living_edited" --frames "$frame" --what color --out "$work/editing/after"
        rows+=(--row "$work/editing/before/$name" "$work/editing/after/$name")
    done
    sheet "$pictures/editing.jpg" "${rows[@]}"
}

objects() {
    given redkitchen objects.jpg || return 0
    # Without the recording's derived masks: objects are found by their geometry.
    run kitchen_geometry "$data/redkitchen" --set masks.source=geometry
    local rows=() frame name
    ggslam render "$work/kitchen_geometry" --frames 40,120 --what color,ids,pca --out "$work/objects"
    for frame in 40 120; do
        name=$(printf 'frame%06d' "$frame")
        rows+=(--row "$work/objects/${name}_color.png" "$work/objects/${name}_ids.png" "$work/objects/${name}_pca.png")
    done
    sheet "$pictures/objects.jpg" "${rows[@]}"
}

volumes() {
    given redkitchen volumes.jpg || return 0
    run kitchen_run "$data/redkitchen"
    ggslam volumes "$work/kitchen_run" --esdf --occupancy 0.08
    local from="$work/kitchen_run/volumes"
    sheet "$pictures/volumes.jpg" --width 1280 --gap 3 --row "$from/mesh.png" --row "$from/esdf.png" "$from/occupancy.png"
}

viewer() {
    given livingroom viewer.jpg || return 0
    command -v chromium > /dev/null || { echo "left as it is: viewer.jpg (needs chromium)"; return 0; }
    run living_run "$data/livingroom"
    ggslam view "$work/living_run" --html "$work/living.html"
    "$python" scripts/tools/screenshot_page.py "$work/living.html" "$work/viewer.png"
    sheet "$pictures/viewer.jpg" --width 1280 --row "$work/viewer.png"
}

film() {
    recording room && run room_run "$work/room"
    ggslam render "$work/room_run" --film "$clips/orbit.gif" --path orbit --seconds 4 --fps 10 --size 320x240
}

clip() {
    recording room
    "$python" scripts/tools/make_clip.py "$work/room" "$clips/clip.gif"
}

# recorded_frame RECORDING NUMBER: the file of a colour image of a generated recording.
recorded_frame() { ls "$work/$1/rgb/"*"$(printf '%06d' "$2")"*; }

for name in "${@:-}"; do
    case "$name" in
        "") for each in overview points loop editing objects volumes viewer clip; do "$each"; done ;;
        overview | points | loop | editing | objects | volumes | viewer | film | clip) "$name" ;;
        *) echo "no such picture: $name" >&2; exit 2 ;;
    esac
done
