// The lab in 3D: the fitted body, the measured points, the ground's forces, the joints' torques, the cameras.

import { effect, type Signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { cameraLines } from "./frusta";
import type { Clock } from "./clock";
import { colourOf, MIDDLE } from "./colours";
import type { Point, Trial } from "./trial";

export interface Layers {
  body: boolean;
  points: boolean;
  forces: boolean;
  torques: boolean;
  cameras: boolean;
}

const LIMB_M = 0.022;
const HEAD_M = 0.095;
const RING_M_PER_NM_KG = 0.12; // a usual knee moment of 0.5 Nm/kg has a ring of 6 cm
const JOINTS = { hip: "hip", knee: "knee", ankle: "ankle" };
const UP = new THREE.Vector3(0, 1, 0);

export function Scene({ trial, clock, layers }: { trial: Trial; clock: Clock; layers: Signal<Layers> }) {
  const place = useRef<HTMLDivElement>(null);
  useEffect(() => {
    const host = place.current!;
    const renderer = new THREE.WebGLRenderer({ antialias: true });
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    host.append(renderer.domElement);
    const stage = new Stage(trial);
    const camera = new THREE.PerspectiveCamera(38, 1, 0.05, 100);
    const controls = new OrbitControls(camera, renderer.domElement);
    stage.frame(camera, controls.target);
    const draw = () => renderer.render(stage.scene, camera);
    controls.addEventListener("change", draw);
    controls.update();
    const fit = new ResizeObserver(() => {
      const { clientWidth: width, clientHeight: height } = host;
      renderer.setSize(width, height);
      camera.aspect = width / Math.max(height, 1);
      camera.updateProjectionMatrix();
      draw();
    });
    fit.observe(host);
    const stop = effect(() => {
      void trial.arrived.value;
      stage.show(trial.frameAt(trial.header.start_s + clock.time_s.value), layers.value);
      draw();
    });
    return () => {
      stop();
      fit.disconnect();
      controls.dispose();
      renderer.dispose();
      renderer.domElement.remove();
    };
  }, [trial]);
  return <div ref={place} class="scene" role="img" aria-label="The skeleton in the lab; drag to turn, scroll to come nearer" />;
}

/** What stands in the lab. Objects are made once and moved. */
class Stage {
  readonly scene = new THREE.Scene();
  private readonly body = new THREE.Group();
  private readonly points = new THREE.Group();
  private readonly forces = new THREE.Group();
  private readonly torques = new THREE.Group();
  private readonly cameras = new THREE.Group();
  private readonly limbs: { mesh: THREE.Mesh; ends: [number, number] }[] = [];
  private readonly head = new THREE.Group();
  private readonly dots: THREE.Mesh[] = [];
  private readonly arrows: THREE.ArrowHelper[] = [];
  private readonly rings: { mesh: THREE.Mesh; marker: number; values: (number | null)[] }[] = [];

  constructor(private readonly trial: Trial) {
    this.scene.background = new THREE.Color("#f5f7f9");
    this.scene.add(new THREE.HemisphereLight("#ffffff", "#b9c2cc", 2.2));
    const sun = new THREE.DirectionalLight("#ffffff", 1.6);
    sun.position.set(2, 5, 3);
    this.scene.add(sun, this.floor(), this.body, this.points, this.forces, this.torques, this.cameras);
    this.makeBody();
    this.makeHead();
    this.makePoints();
    this.makeForces();
    this.makeTorques();
    this.cameras.add(...trial.header.cameras.map((view) => cameraLines(view)));
  }

  /** Look at the whole way from its right side. */
  frame(camera: THREE.PerspectiveCamera, target: THREE.Vector3) {
    const box = new THREE.Box3();
    const { frames, markers } = this.trial.header;
    for (let frame = 0; frame < frames; frame += Math.max(1, Math.floor(frames / 60))) {
      for (let marker = 0; marker < markers.length; marker++) {
        const at = this.trial.point("markers", frame, marker);
        if (at) box.expandByPoint(new THREE.Vector3(...at));
      }
    }
    if (box.isEmpty()) box.set(new THREE.Vector3(-1, 0, -1), new THREE.Vector3(1, 1.8, 1));
    box.getCenter(target);
    const size = box.getSize(new THREE.Vector3());
    const away = 1.1 * Math.max(size.x, 1.4 * size.y) + 1;
    camera.position.set(target.x + 0.45 * away, target.y + 0.25 * away, target.z + away);
    camera.lookAt(target);
  }

  show(frame: number, layers: Layers) {
    this.body.visible = layers.body;
    this.points.visible = layers.points;
    this.forces.visible = layers.forces;
    this.torques.visible = layers.torques && layers.body;
    this.cameras.visible = layers.cameras;
    for (const { mesh, ends } of this.limbs) stretch(mesh, this.marker(frame, ends[0]), this.marker(frame, ends[1]));
    this.poseHead(frame);
    this.dots.forEach((dot, index) => put(dot, this.trial.point("points", frame, index)));
    this.arrows.forEach((arrow, foot) => this.aim(arrow, frame, foot));
    for (const { mesh, marker, values } of this.rings) {
      put(mesh, this.marker(frame, marker));
      const value = values[frame] ?? null;
      mesh.visible &&= value !== null;
      mesh.scale.setScalar(Math.max(RING_M_PER_NM_KG * Math.abs(value ?? 0), 1e-4));
    }
  }

  private marker(frame: number, index: number): Point | null {
    return this.trial.point("markers", frame, index);
  }

  private floor(): THREE.Object3D {
    const group = new THREE.Group();
    const grid = new THREE.GridHelper(8, 16, "#9aa5b1", "#d3dae1");
    const forward = new THREE.ArrowHelper(new THREE.Vector3(1, 0, 0), new THREE.Vector3(-0.5, 0.002, 0), 1, "#5b6675", 0.12, 0.06);
    group.add(grid, forward);
    return group;
  }

  private makeBody() {
    const { markers, marker_lines } = this.trial.header;
    const shape = new THREE.CapsuleGeometry(LIMB_M, 1, 4, 10);
    for (const ends of marker_lines) {
      if (markers[ends[0]] === "nose") continue; // the head is a ball
      const material = new THREE.MeshStandardMaterial({ color: colourOf(markers[ends[0]]!, markers[ends[1]]!), roughness: 0.6 });
      const mesh = new THREE.Mesh(shape, material);
      this.limbs.push({ mesh, ends });
      this.body.add(mesh);
    }
  }

  /** A head, and a neck down to the middle of the shoulders. */
  private makeHead() {
    const material = new THREE.MeshStandardMaterial({ color: MIDDLE, roughness: 0.6 });
    this.head.add(new THREE.Mesh(new THREE.SphereGeometry(HEAD_M, 20, 14), material));
    this.head.add(new THREE.Mesh(new THREE.CapsuleGeometry(LIMB_M, 1, 4, 10), material));
    this.body.add(this.head);
  }

  private poseHead(frame: number) {
    const middle = (...names: string[]) => {
      const found = names.map((name) => this.trial.header.markers.indexOf(name)).map((index) => (index < 0 ? null : this.marker(frame, index)));
      const known = found.filter((at): at is Point => at !== null);
      if (known.length < names.length) return null;
      return [0, 1, 2].map((axis) => known.reduce((sum, at) => sum + at[axis]!, 0) / known.length) as Point;
    };
    const [ears, neck] = [middle("right_ear", "left_ear"), middle("right_shoulder", "left_shoulder")];
    const [skull, spine] = this.head.children as [THREE.Mesh, THREE.Mesh];
    put(skull, ears);
    stretch(spine, ears, neck);
  }

  private makePoints() {
    const shape = new THREE.SphereGeometry(0.016, 10, 8);
    for (const name of this.trial.header.keypoints) {
      const material = new THREE.MeshBasicMaterial({ color: colourOf(name), transparent: true, opacity: 0.75 });
      const dot = new THREE.Mesh(shape, material);
      this.dots.push(dot);
      this.points.add(dot);
    }
  }

  private makeForces() {
    if (!this.trial.has("force")) return;
    for (const _ of ["right", "left"]) {
      const arrow = new THREE.ArrowHelper(UP, new THREE.Vector3(), 1, "#111827", 0.1, 0.06);
      this.arrows.push(arrow);
      this.forces.add(arrow);
    }
  }

  /** The length of an arrow is the force in body weights, in metres. */
  private aim(arrow: THREE.ArrowHelper, frame: number, foot: number) {
    const force = this.trial.point("force", frame, foot);
    const at = this.trial.point("cop", frame, foot);
    arrow.visible = force !== null && at !== null;
    if (!force || !at) return;
    const vector = new THREE.Vector3(...force).divideScalar(this.trial.header.weight_n);
    const length = vector.length();
    arrow.visible = length > 0.02;
    arrow.position.set(...at);
    arrow.setDirection(vector.normalize());
    arrow.setLength(length, Math.min(0.1, 0.4 * length), 0.05);
  }

  private makeTorques() {
    for (const torque of this.trial.report.kinetics?.torques ?? []) {
      const marker = this.trial.header.markers.indexOf(`${torque.side}_${JOINTS[torque.joint]}`);
      if (marker < 0) continue;
      const mesh = new THREE.Mesh(
        new THREE.TorusGeometry(1, 0.14, 8, 40),
        new THREE.MeshStandardMaterial({ color: colourOf(torque.side), emissive: colourOf(torque.side), emissiveIntensity: 0.3 }),
      );
      this.rings.push({ mesh, marker, values: torque.values_nm_kg });
      this.torques.add(mesh);
    }
  }
}

function put(mesh: THREE.Mesh, at: Point | null) {
  mesh.visible = at !== null;
  if (at) mesh.position.set(...at);
}

/** Lay a capsule of length 1 along Y between two points. */
function stretch(mesh: THREE.Mesh, start: Point | null, end: Point | null) {
  mesh.visible = start !== null && end !== null;
  if (!start || !end) return;
  const [a, b] = [new THREE.Vector3(...start), new THREE.Vector3(...end)];
  const along = b.clone().sub(a);
  const length = along.length();
  mesh.position.copy(a).addScaledVector(along, 0.5);
  mesh.scale.set(1, Math.max(length, 1e-3), 1);
  mesh.quaternion.setFromUnitVectors(UP, along.divideScalar(Math.max(length, 1e-6)));
}
