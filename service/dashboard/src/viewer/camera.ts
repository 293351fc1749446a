import type { Point, View } from "./trial";

/** Project a point of the lab into a camera's picture, as OpenCV does (k1 k2 p1 p2 k3); null behind the camera. */
export function project(view: View, point: Point): [number, number] | null {
  const [X, Y, Z] = view.T_cam_lab.slice(0, 3).map((r) => r[0]! * point[0] + r[1]! * point[1] + r[2]! * point[2] + r[3]!) as Point;
  if (Z <= 0.05) return null;
  const [x, y] = [X / Z, Y / Z];
  const [k1, k2, p1, p2, k3] = view.distortion as [number, number, number, number, number];
  const r2 = x * x + y * y;
  const radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
  const u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x);
  const v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y;
  const [fx, fy] = view.intrinsic_px as [number[], number[], number[]];
  return [fx[0]! * u + fx[1]! * v + fx[2]!, fy[1]! * v + fy[2]!];
}
