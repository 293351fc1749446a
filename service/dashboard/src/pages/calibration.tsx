import { useEffect, useRef } from "preact/hooks";
import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { api } from "../api";
import { useLoaded } from "../load";
import { Findings } from "../parts/findings";
import { ProblemNote } from "../parts/problem";
import { cameraLines } from "../viewer/frusta";

const VERDICTS = { accept: "Accepted", warn: "Accepted with warnings", reject: "Rejected" };
const ADVICE = {
  accept: "The cameras agree in pictures that were not used: this calibration can be relied on.",
  warn: "This calibration can be used; read first what is uncertain.",
  reject: "Don't use this calibration. What is seriously wrong stands first, each with its remedy: film that, add it to the session, and calibrate again.",
};

interface RigDocument {
  cameras: { name: string; image_width_px: number; image_height_px: number; intrinsic_px: number[][]; T_lab_cam: number[][] }[];
}

export function CalibrationPage({ id }: { id: string }) {
  const { value, problem } = useLoaded(() => api.calibration(id), id);
  if (!value) return <ProblemNote problem={problem} />;
  const document = value.files.find((file) => file.kind === "document");
  const page = value.files.find((file) => file.kind === "page");
  const picture = (name: string) => value.files.find((file) => file.name === name);
  const [plan, coverage] = [picture("plan.svg"), picture("coverage.svg")];
  return (
    <article class="report">
      <header class="row">
        <h1>
          <a href={`#/sessions/${value.session}`}>{value.name || "Calibration"}</a>
        </h1>
        <span class={`state ${value.verdict}`}>{VERDICTS[value.verdict]}</span>
        <p class="verdict">{ADVICE[value.verdict]}</p>
        {page && (
          <a class="button primary" href={page.url} target="_blank" rel="noopener">
            Page with all numbers
          </a>
        )}
      </header>
      <p class="quiet">
        Cameras {value.cameras.join(", ")}
        {value.left_out.length > 0 && ` (left out: ${value.left_out.join(", ")})`} · board {value.board}
        {value.verdict !== "reject" && value.volume_error_mm !== null && (
          <> · a point in the covered volume is off by {value.volume_error_mm.toFixed(1)} mm through the calibration</>
        )}
      </p>
      <Findings findings={value.findings} />
      <h2>Where the cameras stand</h2>
      {document && <RigScene url={document.url} />}
      {plan && <img class="picture" src={plan.url} alt="The cameras and the board's places in the lab, from above and from the side, in metres" />}
      {coverage && (
        <>
          <h2>Where each camera saw the board</h2>
          <img class="picture" src={coverage.url} alt="The corners of the board in the picture of each camera" />
          <p class="quiet">Blue: corners of the board. Shaded, where the lens was calibrated here: none was seen, nor in a recording of the lens alone; there it is guessed.</p>
        </>
      )}
      <h2>Files</h2>
      <ul class="files">
        {value.files.map((file) => (
          <li key={file.name}>
            <a href={file.url} download={file.name}>
              {file.name}
            </a>
          </li>
        ))}
      </ul>
    </article>
  );
}

function RigScene({ url }: { url: string }) {
  const { value } = useLoaded(() => api.document<RigDocument>(url), url);
  const place = useRef<HTMLDivElement>(null);
  useEffect(() => {
    if (!value) return;
    const host = place.current!;
    const renderer = new THREE.WebGLRenderer({ antialias: true });
    host.append(renderer.domElement);
    const scene = new THREE.Scene();
    scene.background = new THREE.Color("#f5f7f9");
    scene.add(new THREE.GridHelper(10, 20, "#9aa5b1", "#d3dae1"));
    const forward = new THREE.ArrowHelper(new THREE.Vector3(1, 0, 0), new THREE.Vector3(), 1, "#d55e00", 0.12, 0.08);
    scene.add(forward);
    const poses = value.cameras.map((one) => new THREE.Matrix4().set(...(one.T_lab_cam.flat() as Parameters<THREE.Matrix4["set"]>)));
    const box = new THREE.Box3().setFromPoints(poses.map((pose) => new THREE.Vector3().setFromMatrixPosition(pose)));
    const across_m = Math.max(box.getSize(new THREE.Vector3()).length(), 0.5);
    for (const [index, one] of value.cameras.entries()) {
      const pose = poses[index]!;
      const [width_px, height_px] = [one.image_width_px, one.image_height_px];
      const inverse = pose.clone().invert().elements;
      const T_cam_lab = [0, 1, 2, 3].map((row) => [0, 1, 2, 3].map((column) => inverse[4 * column + row]!));
      scene.add(cameraLines({ name: one.name, width_px, height_px, intrinsic_px: one.intrinsic_px, T_cam_lab }, 0.12 * across_m));
    }
    const camera = new THREE.PerspectiveCamera(40, 1, 0.05, 200);
    const controls = new OrbitControls(camera, renderer.domElement);
    const size = 1.1 * across_m + 0.3;
    box.getCenter(controls.target);
    camera.position.copy(controls.target).add(new THREE.Vector3(0.5 * size, 0.5 * size, 0.8 * size));
    const draw = () => renderer.render(scene, camera);
    const fit = new ResizeObserver(() => {
      renderer.setSize(host.clientWidth, host.clientHeight);
      camera.aspect = host.clientWidth / Math.max(host.clientHeight, 1);
      camera.updateProjectionMatrix();
      draw();
    });
    fit.observe(host);
    controls.addEventListener("change", draw);
    controls.update();
    return () => {
      fit.disconnect();
      controls.dispose();
      renderer.dispose();
      renderer.domElement.remove();
    };
  }, [value]);
  return (
    <>
      <div ref={place} class="scene rig" role="img" aria-label="Where the cameras stand, on the floor of the lab" />
      <p class="quiet">The arrow is one metre forward, the way of walking; squares of the grid are 0.5 m. Drag to turn.</p>
    </>
  );
}
