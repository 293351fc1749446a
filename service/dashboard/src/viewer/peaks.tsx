import type { Report, Series, Side } from "../types";
import type { Clock } from "./clock";

interface Peak {
  label: string;
  side: Side;
  joint: string;
  words: string;
  at_s: number;
}

/** The moments that people look for first: each leads there. */
export function Peaks({ report, clock }: { report: Report; clock: Clock }) {
  const peaks = findPeaks(report);
  if (peaks.length === 0) return null;
  return (
    <ul class="peaks" aria-label="Greatest values">
      {peaks.map(({ label, side, joint, words, at_s }) => (
        <li key={label + side}>
          <span class={side}>
            {label}, {side}: <strong>{words}</strong>
          </span>
          <button class="moment" onClick={() => clock.show({ start_s: at_s, end_s: at_s, camera: "", joint: `${side} ${joint}` })}>
            at {at_s.toFixed(2)} s
          </button>
        </li>
      ))}
    </ul>
  );
}

function findPeaks(report: Report): Peak[] {
  const start = report.time_s[0] ?? 0;
  const of = (label: string, joint: string, side: Side, values: Series, band: Series, unit: string, digits: number): Peak[] => {
    // The ends of a recording are the least certain: where there are whole cycles, it is they that count.
    const cycles = report.gait.cycles.filter((cycle) => cycle.side === side && !cycle.left_out);
    const counts = (time_s: number) => cycles.length === 0 || cycles.some((cycle) => time_s >= cycle.start_s && time_s <= cycle.end_s);
    let best = -1;
    values.forEach((value, i) => {
      if (value !== null && (best < 0 || value > values[best]!) && counts(report.time_s[i]!)) best = i;
    });
    if (best < 0) return [];
    const half = band[best] == null ? "" : ` ± ${band[best]!.toFixed(digits)}`;
    return [{ label, side, joint, words: `${values[best]!.toFixed(digits)}${half}${unit}`, at_s: report.time_s[best]! - start }];
  };
  const angles = report.angles
    .filter((one) => one.joint === "knee")
    .flatMap((one) => of("Greatest knee flexion", "knee", one.side, one.values_deg, one.sd_deg.map((sd) => sd && 1.96 * sd), "°", 0));
  const torques = (report.kinetics?.torques ?? [])
    .filter((one) => one.joint === "knee" || one.joint === "ankle")
    .flatMap((one) => {
      const band = one.band_nm.map((band) => band && band / report.body.mass_kg);
      return of(`Greatest ${one.joint} moment`, one.joint, one.side, one.values_nm_kg, band, " Nm/kg", 2);
    });
  return [...angles, ...torques];
}
