import * as THREE from "three";
import type { View } from "./trial";

const LABEL_PX = 44;
const LABEL_SIZE = 0.035; // of the view, however far away

/** A camera in the lab: the lines of its pyramid, and its name. */
export function cameraLines(
  view: Pick<View, "name" | "width_px" | "height_px" | "intrinsic_px" | "T_cam_lab">,
  depth_m = 0.5,
): THREE.Group {
  const [[fx, , cx], [, fy, cy]] = view.intrinsic_px as [[number, number, number], [number, number, number]];
  const corners = [
    [0, 0],
    [view.width_px, 0],
    [view.width_px, view.height_px],
    [0, view.height_px],
  ].map(([u, v]) => new THREE.Vector3((depth_m * (u! - cx)) / fx, (depth_m * (v! - cy)) / fy, depth_m));
  const centre = new THREE.Vector3();
  const points = corners.flatMap((corner, index) => [centre, corner, corner, corners[(index + 1) % 4]!]);
  const lines = new THREE.LineSegments(
    new THREE.BufferGeometry().setFromPoints(points),
    new THREE.LineBasicMaterial({ color: "#5b6675" }),
  );
  const camera = new THREE.Group();
  camera.add(lines, nameOf(view.name));
  const pose = new THREE.Matrix4().set(...(view.T_cam_lab.flat() as Parameters<THREE.Matrix4["set"]>)).invert();
  camera.applyMatrix4(pose);
  return camera;
}

/** A name that stands where the camera is and turns to whoever looks. */
function nameOf(name: string): THREE.Sprite {
  const canvas = document.createElement("canvas");
  const pen = canvas.getContext("2d")!;
  const font = `600 ${LABEL_PX}px system-ui, sans-serif`;
  pen.font = font;
  canvas.width = Math.ceil(pen.measureText(name).width) + 12;
  canvas.height = Math.ceil(1.4 * LABEL_PX);
  pen.font = font; // a canvas that changes its size forgets it
  pen.fillStyle = "#1c2430";
  pen.textBaseline = "middle";
  pen.fillText(name, 6, canvas.height / 2);
  const material = new THREE.SpriteMaterial({ map: new THREE.CanvasTexture(canvas), depthTest: false, sizeAttenuation: false });
  const label = new THREE.Sprite(material);
  label.center.set(0.5, -0.3);
  label.scale.set((LABEL_SIZE * canvas.width) / canvas.height, LABEL_SIZE, 1);
  return label;
}
