"""Find where a camera stands: hand-eye calibration with an ArUco tag on the robot's hand, the camera beside the robot.

    python -m tools.calibrate_camera record --robot-ip 172.16.0.2 --serial 123456789 --out pairs/front
    python -m tools.calibrate_camera solve pairs/front --size 0.06 --out calibration/front.json

`record` asks you to guide the hand to 15 to 20 places, tilted about two axes, all over the picture, and keeps a picture
and the robot's pose of each in pairs.json. That file can be written by anything else too:

    {"serial": "123456789", "intrinsics": {"width": 640, "height": 480, "fx": ..., "fy": ..., "cx": ..., "cy": ...,
     "model": "none", "coefficients": [0, 0, 0, 0, 0]},
     "pairs": [{"base_T_hand": [[4 x 4]], "image": "00.png"},
               {"base_T_hand": [[4 x 4]], "camera_T_tag": [[4 x 4]]}, ...]}

Exit codes: 0 written, 2 something to mend (the message says what).
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from envs.perception.aruco import SQUARE, ArucoTag
from envs.perception.base import Array, PerceptionError
from envs.perception.calibration import Calibration, check_pose, transform
from envs.perception.extra import load
from envs.perception.intrinsics import Intrinsics
from mpc_sgft.command.errors import UserError, disk_error
from mpc_sgft.storage.whole_file import write_whole

NAME = "pairs.json"


def read_pairs(folder: Path, tag: ArucoTag) -> tuple[str, Intrinsics, list[str], Array, Array]:
    """Serial, lens, names of the views that show the tag, poses of the hand [n, 4, 4] m, rays of the corners [n, 4, 3].

    Raises:
        UserError: If the folder does not hold usable pairs.
    """
    path = folder / NAME
    try:
        record = json.loads(path.read_text())
        lens = record["intrinsics"]
        intrinsics = Intrinsics(**lens | {"coefficients": tuple(lens.get("coefficients", (0,) * 5))})
        names, hands, rays = [], [], []
        for number, pair in enumerate(record["pairs"]):
            hand = check_pose(pair["base_T_hand"], f"base_T_hand of pair {number}")
            seen = _rays(folder, pair, number, intrinsics, tag)
            if seen is None:
                print(f"pair {number}: tag {tag.tag} is not seen once in {pair.get('image')}; left out")
            else:
                names.append(str(pair.get("image", number)))
                hands.append(hand)
                rays.append(seen)
        return str(record["serial"]), intrinsics, names, np.array(hands), np.array(rays)
    except FileNotFoundError as err:
        raise UserError(f"there is no {err.filename}; record pairs first: --help says how.") from err
    except KeyError as err:
        raise UserError(f"{path}: {err} is missing; --help shows the format.") from err
    except (ValueError, TypeError, AttributeError) as err:
        raise UserError(f"{path}: {err}; --help shows the format.") from err


def _rays(folder: Path, pair: dict, number: int, intrinsics: Intrinsics, tag: ArucoTag) -> Array | None:
    """Corners of the tag in one view, on the plane z = 1, [4, 3]; None if the picture does not show it."""
    if "camera_T_tag" in pair:
        corners = transform(check_pose(pair["camera_T_tag"], f"camera_T_tag of pair {number}"), SQUARE * tag.size)
        return corners / corners[:, 2:]
    cv2 = load("cv2")
    picture = cv2.imread(str(folder / pair["image"]))
    if picture is None:
        raise ValueError(f"the image {pair['image']} of pair {number} cannot be read")
    if picture.shape[:2] != (intrinsics.height, intrinsics.width):
        raise ValueError(
            f"the image {pair['image']} is not {intrinsics.width}x{intrinsics.height} as the intrinsics say"
        )
    corners = tag.corners(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
    return None if corners is None else intrinsics.rays(corners)


def calibrate(folder: Path, tag: ArucoTag, max_mm: float) -> Calibration:
    """Solve the recorded pairs, and say what came out.

    Raises:
        UserError: If the pairs do not determine the camera's place, or contradict each other by more than `max_mm`.
    """
    from tools.hand_eye import solve

    serial, intrinsics, names, hands, rays = read_pairs(folder, tag)
    try:
        result = solve(hands, rays, tag.size)
    except ValueError as err:
        raise UserError(f"{folder / NAME}: {err}.") from err
    mm, pixels = 1000 * result.residual, result.pixels * intrinsics.fx
    for name, distance, miss in zip(names, mm, pixels, strict=True):
        print(f"{name}: {distance:.2f} mm, {miss:.2f} pixel")
    typical, position = float(np.median(mm)), result.base_T_camera[:3, 3]
    print(f"residual: median {typical:.2f} mm, largest {mm.max():.2f} mm, over {len(mm)} pairs")
    print(
        f"camera {serial} at {np.round(position, 4).tolist()} m,"
        f" +- {np.round(1000 * result.position_sd, 2).tolist()} mm"
    )
    if typical > max_mm:
        raise UserError(
            f"the pairs contradict each other: median {typical:.1f} mm, at most {max_mm} mm (--max-mm). Nothing was"
            f" written. Check --size (now {tag.size} m), that the tag sits fast on the hand; leave out the worst pairs."
        )
    return Calibration(
        serial=serial,
        intrinsics=intrinsics,
        base_T_camera=result.base_T_camera,
        residual_mm=round(typical, 3),
        pairs=len(mm),
    )


def main(argv: Sequence[str] | None = None) -> int:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    take = commands.add_parser("record", help="guide the hand, keep pictures and poses")
    take.add_argument("--robot-ip", required=True, help="of the robot's controller")
    take.add_argument("--serial", required=True, help="of the camera")
    take.add_argument("--out", type=Path, required=True, help="folder of the pairs; one of before goes on")
    take.add_argument("--recording", type=Path, help="a .db3 file in place of the camera")
    find = commands.add_parser("solve", help="compute the calibration file")
    find.add_argument("pairs", type=Path, help=f"folder with {NAME}")
    find.add_argument("--out", type=Path, required=True, help="calibration file to write")
    find.add_argument("--dictionary", default="DICT_4X4_50", help="the tag's family (DICT_4X4_50)")
    find.add_argument("--tag", type=int, default=0, help="its number (0)")
    find.add_argument("--size", type=float, required=True, help="[m] a side of its black square: measure the print")
    find.add_argument("--max-mm", type=float, default=5.0, help="largest median residual that is accepted (5)")
    args = parser.parse_args(argv)
    try:
        if args.command == "record":
            from tools.record_pairs import record

            record(args.robot_ip, args.serial, args.out, args.recording)
        else:
            tag = ArucoTag(dictionary=args.dictionary, tag=args.tag, size=args.size, offset=(0, 0, 0), max_error=2.0)
            write_whole(args.out, calibrate(args.pairs, tag, args.max_mm).to_json().encode())
            print(args.out)
    except (UserError, PerceptionError, ValueError) as err:
        print(f"calibrate_camera: {err}", file=sys.stderr)
        return 2
    except OSError as err:
        print(f"calibrate_camera: {disk_error(err) or err}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
