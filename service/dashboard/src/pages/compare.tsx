// Two trials in one view: right and left of both, over the gait cycle, with the two bodies in step.

import { effect, useSignal } from "@preact/signals";
import { useEffect, useMemo, useState } from "preact/hooks";
import { api } from "../api";
import { useLoaded } from "../load";
import { ProblemNote } from "../parts/problem";
import { VERDICTS } from "./report";
import type { Cycle, Parameter, Report, Side } from "../types";
import { Clock } from "../viewer/clock";
import { fixed } from "../viewer/fixed";
import { CycleCurves, hasCycles, TimeCurves } from "../viewer/curves";
import { Scene, type Layers } from "../viewer/scene";
import { Transport } from "../viewer/transport";
import { loadTrial, type Trial } from "../viewer/trial";

interface Named {
  trial: Trial;
  name: string;
}

export function ComparePage({ first, second }: { first: string; second: string }) {
  const load = async (): Promise<[Named, Named]> => Promise.all([loadNamed(first), loadNamed(second)]);
  const { value, problem } = useLoaded(load, `${first} ${second}`);
  if (!value) return problem ? <ProblemNote problem={problem} /> : <p class="quiet">Loading two trials …</p>;
  return <Comparison ids={[first, second]} both={value} />;
}

async function loadNamed(id: string): Promise<Named> {
  const [trial, job] = await Promise.all([loadTrial(id), api.job(id)]);
  return { trial, name: (await api.session(job.session)).name || "unnamed" };
}

function Comparison({ ids, both }: { ids: [string, string]; both: [Named, Named] }) {
  const [one, other] = both.map(({ trial }) => trial) as [Trial, Trial];
  const clocks = useMemo(() => both.map(({ trial }) => new Clock(trial.duration_s, trial.header.rate_hz)) as [Clock, Clock], both);
  const [only, setOnly] = useState<Side>();
  const cyclic = hasCycles(one.report) && hasCycles(other.report);
  const layers = useSignal<Layers>({ body: true, points: false, forces: true, torques: true, cameras: false });
  useEffect(() => effect(() => clocks[1].seek(inStep(one.report, other.report, clocks[0].time_s.value))), clocks);
  return (
    <article class="report">
      <header class="row">
        <h1>Two trials</h1>
        <a class="button" href={`#/compare/${ids[1]}/${ids[0]}`}>
          Exchange
        </a>
      </header>
      <div class="stage pair">
        {both.map(({ trial, name }, i) => (
          <section key={ids[i]} aria-label={name}>
            <h2>
              <a href={`#/reports/${ids[i]}`}>{name}</a> {cyclic && <span class="quiet">{i === 0 ? "full lines" : "dotted lines"}</span>}
            </h2>
            <p>
              <span class={`state ${trial.report.verdict.level}`}>{VERDICTS[trial.report.verdict.level]}</span> {trial.report.verdict.sentence}
              {trial.header.cameras.length === 1 && " Seen by one camera: what moves towards it and away is not measured."}
            </p>
            <Scene trial={trial} clock={clocks[i]!} layers={layers} />
          </section>
        ))}
      </div>
      <Transport clock={clocks[0]} />
      <div class="row">
        <div class="tabs" role="group" aria-label="Sides">
          {([undefined, "right", "left"] as const).map((side) => (
            <button key={side} aria-pressed={only === side} onClick={() => setOnly(side)}>
              {side ? `${side[0]!.toUpperCase()}${side.slice(1)}` : "Both sides"}
            </button>
          ))}
        </div>
        <p class="legend">
          <span class="right">right</span> <span class="left">left</span> · {cyclic && `dotted: ${both[1].name} · `}shaded: 95 % band of the error
          {cyclic && " · grey: healthy people"}
        </p>
      </div>
      {cyclic ? (
        <CycleCurves report={one.report} clock={clocks[0]} other={other.report} only={only} />
      ) : (
        <>
          <p class="quiet">Not both have a whole gait cycle, over which they could be laid upon each other: here they are over time.</p>
          {both.map(({ trial, name }, i) => (
            <section key={ids[i]} aria-label={`Curves of ${name}`}>
              <h2>{name}</h2>
              <TimeCurves report={trial.report} clock={clocks[i]!} only={only} />
            </section>
          ))}
        </>
      )}
      <h2>Parameters</h2>
      <Differences names={[both[0].name, both[1].name]} reports={[one.report, other.report]} />
    </article>
  );
}

/** The moment of the other trial that is at the same place of the gait cycle; without cycles, as long after the beginning. */
function inStep(report: Report, other: Report, time_s: number): number {
  const [a, b] = [firstCycle(report), firstCycle(other)];
  if (!a || !b) return time_s;
  const share = (time_s + (report.time_s[0] ?? 0) - a.start_s) / (a.end_s - a.start_s);
  return b.start_s + share * (b.end_s - b.start_s) - (other.time_s[0] ?? 0);
}

function firstCycle(report: Report): Cycle | undefined {
  const counted = report.gait.cycles.filter((cycle) => !cycle.left_out);
  return counted.find((cycle) => cycle.side === "right") ?? counted[0];
}

const digits = (value: number) => fixed(value, Math.abs(value) < 10 ? 2 : 1);

function Differences({ names, reports }: { names: [string, string]; reports: [Report, Report] }) {
  const all = [...new Set(reports.flatMap((report) => report.gait.parameters.map((one) => one.name)))];
  if (all.length === 0) return <p class="empty">No whole step was seen in either trial.</p>;
  const of = (i: 0 | 1, name: string) => reports[i].gait.parameters.find((one) => one.name === name);
  const sides = ["both", "right", "left"] as const;
  const known = (name: string) => sides.filter((side) => of(0, name)?.[side] || of(1, name)?.[side]);
  const number = (found: Parameter["both"] | undefined) => (found ? `${digits(found.mean)}${found.sd === null ? "" : ` ± ${digits(found.sd)}`}` : "–");
  return (
    <table>
      <thead>
        <tr>
          <th>Parameter</th>
          <th>Side</th>
          <th>{names[0]}</th>
          <th>{names[1]}</th>
          <th>Second less first</th>
        </tr>
      </thead>
      <tbody>
        {all.flatMap((name) =>
          known(name).map((side) => {
            const [a, b] = [of(0, name)?.[side], of(1, name)?.[side]];
            return (
              <tr key={name + side}>
                <td>
                  {name}, {(of(0, name) ?? of(1, name))?.unit}
                </td>
                <td>{side}</td>
                <td>{number(a)}</td>
                <td>{number(b)}</td>
                <td>{a && b ? digits(b.mean - a.mean) : "–"}</td>
              </tr>
            );
          }),
        )}
      </tbody>
    </table>
  );
}
