import { useMemo, useRef, useState } from "preact/hooks";
import { api, Problem } from "../api";
import { useLoaded } from "../load";
import { isActive, JobRow } from "../parts/job";
import { MeasuredForm, measuredParameters, NOTHING_MEASURED } from "../parts/measured";
import { type Chosen, Options, parametersOf } from "../parts/options";
import { ProblemNote } from "../parts/problem";
import { Uploads } from "../parts/uploads";
import type { UploadedFile } from "../types";

const ROLES: Record<string, string> = {
  video: "video",
  keypoints: "keypoints",
  calibration: "calibration",
  pressure: "foot pressure",
  pressure_card: "card of the foot pressure",
  force_plates: "force plates",
  force_coefficients: "coefficients of the forces",
  body_model: "body model",
  marker_set: "marker set",
  sweep: "sweep of the board",
  lens: "board for one lens",
  floor: "board on the floor",
  board: "card of the board",
  optics: "known lenses",
  floor_points: "points on the floor",
  previous: "earlier calibration",
  joint_tree: "joint tree",
  tracks: "marks of the parts",
  background: "marks of the background",
  picture: "photograph",
};

export function SessionPage({ id }: { id: string }) {
  const session = useLoaded(() => api.session(id), id);
  const files = useLoaded(() => api.files(id), `${id} files`);
  const jobs = useLoaded(() => api.jobs(id), `${id} jobs`);
  const uploads = useMemo(() => new Uploads(id, files.again), [id]);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [options, setOptions] = useState<Chosen>({});
  const [measured, setMeasured] = useState(NOTHING_MEASURED);
  if (!session.value) return <ProblemNote problem={session.problem} />;
  const isCalibration = session.value.kind === "calibration";
  const parameters = () => (isCalibration ? measuredParameters(measured) : parametersOf(options));
  const verb = isCalibration ? "Calibrate" : "Analyse";
  const busy = jobs.value?.some(isActive) ?? false;
  const attempt = (work: () => Promise<unknown>, after: () => void) => async () => {
    setProblem(null);
    try {
      await work();
      after();
    } catch (error) {
      setProblem(error as Problem);
    }
  };
  const remove = () => {
    if (confirm("Delete this session with its files and reports? Nothing of it is kept.")) return api.deleteSession(id);
    return Promise.reject(new Problem(0, "", "Nothing was deleted.", ""));
  };
  return (
    <>
      <div class="row">
        <h1>{session.value.name || "Unnamed session"}</h1>
        {session.value.subject.code && <a href={`#/subjects/${encodeURIComponent(session.value.subject.code)}`}>Subject {session.value.subject.code}</a>}
        <button class="primary" disabled={busy || !files.value?.length} onClick={attempt(() => api.analyse(id, parameters()), jobs.again)}>
          {verb}
        </button>
      </div>
      <ProblemNote problem={problem ?? files.problem ?? jobs.problem} />
      <DropZone uploads={uploads} kind={session.value.kind} />
      {session.value.kind.startsWith("human") && <Options chosen={options} onChange={setOptions} />}
      {isCalibration && <MeasuredForm value={measured} cameras={sweepsOf(files.value ?? [])} onChange={setMeasured} />}
      <h2>Files</h2>
      {files.value && <Files files={files.value} onDelete={(file) => attempt(() => api.deleteFile(id, file), files.again)()} />}
      <h2>Jobs</h2>
      {jobs.value?.length === 0 && <p class="empty">Not started yet. When all files are here, press “{verb}”.</p>}
      <ul class="jobs">
        {jobs.value?.map((job) => (
          <JobRow key={job.id} job={job} onEnd={jobs.again} />
        ))}
      </ul>
      <p>
        <button class="quiet" onClick={attempt(remove, () => (location.hash = "#/"))}>
          Delete this session
        </button>
      </p>
    </>
  );
}

/** The cameras that filmed the board together. */
function sweepsOf(files: UploadedFile[]): string[] {
  const sweeps = files.filter((file) => file.role === "sweep");
  return [...new Set(sweeps.map((file) => file.camera ?? file.name.replace(/\.[^.]*$/, "")))].sort();
}

const WANTED: Record<string, string> = {
  human_multicamera: "Drop the cameras' videos here, the calibration if it is a file, the pressure soles' table.",
  human_monocular: "Drop the camera's video here, and its calibration if it is a file.",
  articulated_object: "Drop body.toml and tracks.csv here, and what tells the cameras: cameras.json, background.csv, or the photographs.",
  calibration: "Drop each camera's video of the board here, named after the camera, and the board's card (board.toml).",
};

/** What videos of a board may show; a camera's lens and its sweep have one name, so that of the lens is sent with its role. */
const SHOWN: Record<string, string> = {
  sweep: "all cameras filming the board at the same time",
  lens: "one camera alone, the board close: its lens",
  floor: "the board on the floor",
};
const isFilm = (file: File) => /\.(mp4|mov|avi|mkv|m4v|mts|m2ts|mpe?g|webm|wmv)$/i.test(file.name);
const isPhotograph = (file: File) => /\.(jpe?g|png|bmp|tiff?|webp)$/i.test(file.name);

/** What a file's name doesn't tell. A lens needs many photographs, whose names don't tell the camera; the floor needs one a camera. */
function roleOf(file: File, shown: string): string {
  return shown !== "sweep" && (isFilm(file) || (shown === "floor" && isPhotograph(file))) ? shown : "";
}

function DropZone({ uploads, kind }: { uploads: Uploads; kind: string }) {
  const picker = useRef<HTMLInputElement>(null);
  const [over, setOver] = useState(false);
  const [shown, setShown] = useState("sweep");
  const add = (files: Iterable<File>) => uploads.add(files, (file) => roleOf(file, shown));
  const drop = (event: DragEvent) => {
    event.preventDefault();
    setOver(false);
    add(event.dataTransfer?.files ?? []);
  };
  return (
    <section
      class={over ? "drop over" : "drop"}
      aria-label="Upload"
      onDragOver={(event) => {
        event.preventDefault();
        setOver(true);
      }}
      onDragLeave={() => setOver(false)}
      onDrop={drop}
    >
      {kind === "calibration" && (
        <label>
          The videos show{" "}
          <select value={shown} onChange={(event) => setShown(event.currentTarget.value)}>
            {Object.entries(SHOWN).map(([role, words]) => (
              <option key={role} value={role}>
                {words}
              </option>
            ))}
          </select>
        </label>
      )}
      <p>
        {WANTED[kind]}{" "}
        <button onClick={() => picker.current?.click()}>Choose files</button>
      </p>
      <input ref={picker} type="file" multiple hidden aria-label="Files to upload" onChange={(e) => add(e.currentTarget.files ?? [])} />
      <ul class="uploads">
        {uploads.list.value.map((one) => (
          <li key={one.name} class={one.state}>
            <span>{one.name}</span>
            <progress max={one.file.size} value={one.sent} aria-label={`Upload of ${one.name}`} />
            <span>{one.state === "sending" ? `${Math.round((100 * one.sent) / Math.max(one.file.size, 1))} %` : one.state}</span>
            {one.problem && one.state !== "done" && <ProblemNote problem={one.problem} />}
          </li>
        ))}
      </ul>
    </section>
  );
}

function Files({ files, onDelete }: { files: UploadedFile[]; onDelete: (id: string) => void }) {
  if (files.length === 0) return <p class="empty">No files yet.</p>;
  return (
    <table>
      <thead>
        <tr>
          <th>File</th>
          <th>What it is</th>
          <th>What gonio saw in it</th>
          <th>Size</th>
          <th />
        </tr>
      </thead>
      <tbody>
        {files.map((file) => (
          <tr key={file.id}>
            <td>{file.name}</td>
            <td>
              {ROLES[file.role] ?? file.role}
              {file.camera && ` of ${file.camera}`}
            </td>
            <td>{describeFacts(file.facts)}</td>
            <td>{sizeOf(file.size)}</td>
            <td>
              <button class="quiet" onClick={() => onDelete(file.id)} aria-label={`Delete ${file.name}`}>
                Delete
              </button>
            </td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}

export const sizeOf = (bytes: number) => (bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`);

function describeFacts(facts: Record<string, unknown>): string {
  if (typeof facts.width_px === "number" && typeof facts.rate_hz === "number") {
    return `${facts.width_px} × ${facts.height_px}, ${(facts.rate_hz as number).toFixed(1)} Hz, ${facts.frames} frames`;
  }
  return Object.entries(facts)
    .map(([name, value]) => {
      const [, words, unit] = /^(.*?)(?:_(mm|px|hz|kg|m|s))?$/.exec(name)!;
      const shown = Array.isArray(value) ? value.join(", ") : String(value);
      return `${words!.replace(/_/g, " ")} ${shown}${unit ? ` ${unit === "hz" ? "Hz" : unit}` : ""}`;
    })
    .join("; ");
}
