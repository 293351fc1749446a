import * as THREE from "three";
import type { View } from "./trial";

/** A camera as the lines of its pyramid in the lab. */
export function cameraLines(
  view: Pick<View, "width_px" | "height_px" | "intrinsic_px" | "T_cam_lab">,
  depth_m = 0.5,
): THREE.LineSegments {
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
  const pose = new THREE.Matrix4().set(...(view.T_cam_lab.flat() as Parameters<THREE.Matrix4["set"]>)).invert();
  lines.applyMatrix4(pose);
  return lines;
}
