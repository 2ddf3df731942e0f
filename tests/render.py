"""Pictures of a table with a tag and two pucks, for tests: run as a script, because MuJoCo chooses its renderer when it
is imported. Reads {"size", "tag_size", "number", "shots": [{"camera", "tag", "puck", "other"}]}; writes color and
depth."""

import json
import sys

import cv2
import mujoco
import numpy as np

CELLS, PIXELS = 6, 60  # of a 4 x 4 tag with its black border; pixels of the texture a cell
AWAY = np.array([0, 0, -9.0])
OPENCV = np.diag([1.0, -1.0, -1.0])  # OpenCV's camera looks along z with y downwards, MuJoCo's along -z with y upwards


def texture(number: int) -> np.ndarray:
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    tag = cv2.aruco.generateImageMarker(family, number, CELLS * PIXELS)
    return cv2.copyMakeBorder(tag, PIXELS, PIXELS, PIXELS, PIXELS, cv2.BORDER_CONSTANT, value=255)


def scene(width: int, height: int, fovy: float, tag_size: float, number: int) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.3] * 3
    spec.visual.map.znear, spec.visual.map.zfar, spec.stat.extent = 0.01, 5.0, 1.0
    world = spec.worldbody
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], rgba=[0.6, 0.6, 0.55, 1])
    world.add_camera(name="camera", fovy=fovy)
    rgb = np.repeat(texture(number)[..., None], 3, 2)
    added = spec.add_texture(
        name="tag", type=mujoco.mjtTexture.mjTEXTURE_2D, width=len(rgb), height=len(rgb), nchannel=3
    )
    added.data = rgb.tobytes()
    material = spec.add_material(name="tag", texuniform=False, texrepeat=[1, 1])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tag"
    side = tag_size * (CELLS + 2) / CELLS
    for name in ("tag", "puck", "other"):
        body = world.add_body(name=name, pos=AWAY, mocap=True)
        if name == "tag":
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[side / 2, side / 2, 0.1], material="tag")
        else:
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.025, 0.015, 0], rgba=[0.85, 0.1, 0.1, 1])
    return spec.compile()


def place(data: mujoco.MjData, name: str, pose: np.ndarray) -> None:
    k = data.model.body(name).mocapid[0]
    data.mocap_pos[k] = pose[:3, 3]
    mujoco.mju_mat2Quat(data.mocap_quat[k], pose[:3, :3].ravel())


def main(order: dict, path: str) -> None:
    width, height = order["size"]
    model = scene(width, height, order["fovy"], order["tag_size"], order["number"])
    data = mujoco.MjData(model)
    colors, depths = [], []
    with mujoco.Renderer(model, height, width) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        for shot in order["shots"]:
            for name in ("tag", "puck", "other"):
                hidden = np.eye(4)
                hidden[:3, 3] = AWAY
                place(data, name, np.array(shot[name]) if shot.get(name) else hidden)
            camera = np.array(shot["camera"])
            model.cam_pos[0] = camera[:3, 3]
            mujoco.mju_mat2Quat(model.cam_quat[0], (camera[:3, :3] @ OPENCV).ravel())
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, "camera")
            colors.append(renderer.render())
            renderer.enable_depth_rendering()
            renderer.update_scene(data, "camera")
            depths.append(renderer.render())
            renderer.disable_depth_rendering()
    np.savez(path, color=np.array(colors), depth=np.array(depths))


if __name__ == "__main__":
    main(json.load(sys.stdin), sys.argv[1])
