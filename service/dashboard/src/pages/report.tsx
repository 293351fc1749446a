import { useSignal } from "@preact/signals";
import { useMemo, useRef, useState } from "preact/hooks";
import { api } from "../api";
import { useLoaded } from "../load";
import { Findings } from "../parts/findings";
import { ProblemNote } from "../parts/problem";
import { sizeOf } from "./session";
import type { Finding, Parameter, ResultFile, Session } from "../types";
import { Clock } from "../viewer/clock";
import { CycleCurves, hasCycles, TimeCurves } from "../viewer/curves";
import { Films } from "../viewer/films";
import { Peaks } from "../viewer/peaks";
import { Scene, type Layers } from "../viewer/scene";
import { Transport } from "../viewer/transport";
import { loadTrial, type Trial } from "../viewer/trial";

export const VERDICTS = { good: "Good", usable: "Usable with care", poor: "Poor" };
const LAYERS: Record<keyof Layers, string> = {
  body: "body",
  points: "measured points",
  forces: "ground forces",
  torques: "torques",
  cameras: "cameras",
};

export function ReportPage({ id, session }: { id: string; session: Session }) {
  const { value: trial, problem } = useLoaded(() => loadTrial(id), id);
  if (!trial) return problem ? <ProblemNote problem={problem} /> : <p class="quiet">Loading the movement …</p>;
  return <TrialView id={id} session={session} trial={trial} />;
}

function TrialView({ id, session, trial }: { id: string; session: Session; trial: Trial }) {
  const { report, header, files } = trial;
  const clock = useMemo(() => new Clock(trial.duration_s, header.rate_hz), [trial]);
  const layers = useSignal<Layers>({ body: true, points: false, forces: true, torques: true, cameras: false });
  const [over, setOver] = useState<"cycle" | "time">(hasCycles(report) ? "cycle" : "time");
  const page = files.find((file) => file.kind === "page");
  const known = (name: keyof Layers) => !(["forces", "torques"].includes(name) && !report.kinetics);
  const stage = useRef<HTMLDivElement>(null);
  const showFinding = ({ start_s, end_s, camera, joint }: Finding) => {
    const first_s = report.time_s[0] ?? 0;
    if (start_s == null) return;
    setOver("time"); // the cycle's curves show one stretch of the trial only
    clock.show({ start_s: start_s - first_s, end_s: (end_s ?? start_s) - first_s, camera: camera ?? "", joint: joint ?? "" });
    stage.current?.scrollIntoView({ block: "start" });
  };
  return (
    <article class="report">
      <header class="row">
        <h1>
          <a href={`#/sessions/${session.id}`}>{session.name || "Unnamed session"}</a>
        </h1>
        <span class={`state ${report.verdict.level}`}>{VERDICTS[report.verdict.level]}</span>
        <p class="verdict">{report.verdict.sentence}</p>
        {page && (
          <a class="button primary" href={page.url} target="_blank" rel="noopener">
            Page to print
          </a>
        )}
      </header>
      <div class="stage" ref={stage}>
        <section aria-label="Skeleton">
          <Scene trial={trial} clock={clock} layers={layers} />
          <div class="layers" role="group" aria-label="What the scene shows">
            {(Object.keys(LAYERS) as (keyof Layers)[]).filter(known).map((name) => (
              <label key={name}>
                <input type="checkbox" checked={layers.value[name]} onChange={() => (layers.value = { ...layers.value, [name]: !layers.value[name] })} />
                {LAYERS[name]}
              </label>
            ))}
          </div>
        </section>
        <section aria-label="Videos">
          <Films trial={trial} clock={clock} />
        </section>
      </div>
      <Transport clock={clock} />
      <Peaks report={report} clock={clock} />
      <section aria-label="Curves">
        <div class="row">
          <div class="tabs" role="group" aria-label="Curves over">
            <button aria-pressed={over === "cycle"} onClick={() => setOver("cycle")}>
              Gait cycle
            </button>
            <button aria-pressed={over === "time"} onClick={() => setOver("time")}>
              Whole trial
            </button>
          </div>
          <p class="legend">
            <span class="right">right</span> <span class="left">left</span> · shaded: 95 % band of the error
            {over === "cycle" ? " · grey: healthy people" : " · lines: initial contact, dashed toe-off"}
          </p>
        </div>
        {over === "time" ? <TimeCurves report={report} clock={clock} /> : <Cycles id={id} trial={trial} clock={clock} />}
      </section>
      <div class="columns">
        <section>
          <h2>Findings</h2>
          <Findings findings={report.findings} onMoment={showFinding} />
        </section>
        <section>
          <h2>Gait</h2>
          <Parameters parameters={report.gait.parameters} />
          <h2>Files</h2>
          <Downloads files={files} />
        </section>
      </div>
    </article>
  );
}

function Cycles({ id, trial, clock }: { id: string; trial: Trial; clock: Clock }) {
  const [chosen, setChosen] = useState("");
  const { value: choices } = useLoaded(otherReports, "other reports");
  const { value: other } = useLoaded(() => (chosen ? api.report(chosen) : Promise.resolve(null)), chosen);
  return (
    <>
      <label class="inline">
        Compare with{" "}
        <select value={chosen} onChange={(event) => setChosen(event.currentTarget.value)}>
          <option value="">no other trial</option>
          {choices
            ?.filter((choice) => choice.id !== id)
            .map((choice) => (
              <option key={choice.id} value={choice.id}>
                {choice.label}
              </option>
            ))}
        </select>
      </label>{" "}
      {chosen && <a href={`#/compare/${id}/${chosen}`}>Both side by side</a>}
      <CycleCurves report={trial.report} clock={clock} other={chosen ? other : null} />
    </>
  );
}

async function otherReports(): Promise<{ id: string; label: string }[]> {
  const [jobs, sessions] = await Promise.all([api.jobs(), api.sessions()]);
  const names = new Map(sessions.filter(({ kind }) => kind.startsWith("human")).map((session) => [session.id, session.name || "unnamed"]));
  return jobs
    .filter((job) => job.report && names.has(job.session))
    .map((job) => ({ id: job.id, label: `${names.get(job.session)}, ${new Date(job.created_at).toLocaleString()}` }));
}

function Parameters({ parameters }: { parameters: Parameter[] }) {
  if (parameters.length === 0) return <p class="quiet">No whole step was seen.</p>;
  const show = (found: Parameter["both"]) => (found ? `${digits(found.mean)}${found.sd === null ? "" : ` ± ${digits(found.sd)}`}` : "–");
  return (
    <table>
      <thead>
        <tr>
          <th>Parameter</th>
          <th>Both</th>
          <th>Right</th>
          <th>Left</th>
          <th>Usual</th>
        </tr>
      </thead>
      <tbody>
        {parameters.map((one) => (
          <tr key={one.name}>
            <td>
              {one.name}, {one.unit}
            </td>
            <td>{show(one.both)}</td>
            <td>{show(one.right)}</td>
            <td>{show(one.left)}</td>
            <td>{one.usual === null ? "–" : digits(one.usual)}</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}

const digits = (value: number) => (Math.abs(value) < 10 ? value.toFixed(2) : value.toFixed(0));

export function Downloads({ files }: { files: ResultFile[] }) {
  return (
    <ul class="files">
      {files
        .filter((file) => !file.name.endsWith(".f32"))
        .map((file) => (
          <li key={file.name}>
            <a href={file.url} download={file.name}>
              {file.name}
            </a>{" "}
            <span class="quiet">{sizeOf(file.size)}</span>
          </li>
        ))}
    </ul>
  );
}
