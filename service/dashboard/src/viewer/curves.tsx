// Curves over the trial and over the gait cycle, with the bands of their errors; hovering moves the clock.

import { effect } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import type { CycleCurve, GaitEvent, Report, Series, Side } from "../types";
import type { Clock, Meant } from "./clock";
import { LEFT, RIGHT } from "./colours";
import { fixed } from "./fixed";

const COLOURS = { right: RIGHT, left: LEFT };
const SIDES: Side[] = ["right", "left"];
const BAND_SD = 1.96;
const HEIGHT = 190;
const BUCKETS = 500; // a curve is hardly wider than that in pixels
const PERCENT = Array.from({ length: 101 }, (_, i) => i);

interface Line {
  side: Side;
  values: Series;
  band: Series; // half of its width
}

interface Chart {
  title: string;
  x: number[];
  lines: Line[];
  extra: { label: string; low: Series; middle: Series | null; high: Series; colour: string; fill: string; dash?: number[] }[];
  unit: string;
}

const add = (a: Series, b: Series, sign: 1 | -1): Series =>
  a.map((value, i) => (value === null || b[i] == null ? null : value + sign * b[i]!));

/** The angles and torques of the trial over time. */
export function TimeCurves({ report, clock, only }: { report: Report; clock: Clock; only?: Side }) {
  const isShown = ({ side }: { side: Side }) => only === undefined || side === only;
  const start = report.time_s[0] ?? 0;
  const x = report.time_s.map((time) => time - start);
  const angles = ["knee", "hip", "ankle"].map((joint): Chart => {
    const sides = report.angles.filter((angle) => angle.joint === joint && isShown(angle));
    return {
      title: `${sides[0]?.name ?? joint}, degrees (${sides[0]?.positive ?? ""} positive)`,
      x,
      unit: "°",
      lines: sides.map((angle) => ({ side: angle.side, values: angle.values_deg, band: angle.sd_deg.map((sd) => (sd === null ? null : BAND_SD * sd)) })),
      extra: [],
    };
  });
  const mass = report.body.mass_kg;
  const torques = ["knee", "hip", "ankle"].flatMap((joint): Chart[] => {
    const sides = report.kinetics?.torques.filter((torque) => torque.joint === joint && isShown(torque)) ?? [];
    if (sides.length === 0) return [];
    return [
      {
        title: `${joint[0]!.toUpperCase()}${joint.slice(1)} moment, Nm/kg (${sides[0]!.positive} positive)`,
        x,
        unit: " Nm/kg",
        lines: sides.map((torque) => ({
          side: torque.side,
          values: torque.values_nm_kg,
          band: torque.band_nm.map((band) => (band === null ? null : band / mass)),
        })),
        extra: [],
      },
    ];
  });
  const events = report.gait.events.map((event) => ({ ...event, time_s: event.time_s - start }));
  return (
    <div class="curves">
      {[...angles, ...torques].map((chart) => (
        <Plot key={`${chart.title} ${only}`} chart={chart} clock={clock} toTime={(x) => x} fromTime={(t) => t} events={events} />
      ))}
    </div>
  );
}

/** The mean curves over the gait cycle, beside healthy people and, if there is one, another trial. */
export function CycleCurves({ report, clock, other, only }: { report: Report; clock: Clock; other: Report | null; only?: Side }) {
  const shown = only ? [only] : SIDES;
  const start = report.time_s[0] ?? 0;
  const first = (side: Side) => report.gait.cycles.find((cycle) => cycle.side === side && !cycle.left_out);
  const quantities = [...new Set(report.gait.curves.map((curve) => curve.quantity))].sort((a, b) => rank(a) - rank(b));
  const charts = quantities.map((quantity): Chart => {
    const of = (from: Report, side: Side) => from.gait.curves.find((curve) => curve.quantity === quantity && curve.side === side);
    const sides = shown.map((side) => of(report, side)).filter((curve): curve is CycleCurve => curve !== undefined);
    const norm = sides[0]?.norm;
    return {
      title: `${sides[0]?.name}, ${sides[0]?.unit === "deg" ? "degrees" : sides[0]?.unit} (${sides[0]?.positive} positive)`,
      x: PERCENT,
      unit: sides[0]?.unit === "deg" ? "°" : ` ${sides[0]?.unit}`,
      lines: sides.map((curve) => ({
        side: curve.side,
        values: curve.mean,
        band: curve.error_sd.map((sd) => (sd === null ? null : BAND_SD * sd)),
      })),
      extra: [
        ...(norm ? [{ label: "healthy, mean ± SD", low: add(norm.mean, norm.sd, -1), middle: null, high: add(norm.mean, norm.sd, 1), colour: "#9a9a9a", fill: "#9a9a9a44" }] : []),
        ...(other
          ? shown.flatMap((side) => {
              const curve = of(other, side);
              const half = curve?.error_sd.map((sd) => (sd === null ? 0 : BAND_SD * sd)) ?? [];
              const [low, high] = curve ? [add(curve.mean, half, -1), add(curve.mean, half, 1)] : [[], []];
              return curve ? [{ label: `${side}, other trial`, low, middle: curve.mean, high, colour: COLOURS[side], fill: `${COLOURS[side]}14`, dash: [2, 4] }] : [];
            })
          : []),
      ],
    };
  });
  const cycle = first("right") ?? first("left");
  const toTime = (percent: number) => (cycle ? cycle.start_s - start + (percent / 100) * (cycle.end_s - cycle.start_s) : null);
  const fromTime = (time: number) => (cycle ? (100 * (time + start - cycle.start_s)) / (cycle.end_s - cycle.start_s) : null);
  if (!hasCycles(report)) return <p class="empty">There is no whole gait cycle in this recording. The curves over time are complete.</p>;
  return (
    <div class="curves">
      {charts.map((chart) => (
        <Plot key={`${chart.title} ${only}`} chart={chart} clock={clock} toTime={toTime} fromTime={fromTime} events={[]} />
      ))}
    </div>
  );
}

export const hasCycles = (report: Report) => report.gait.curves.some((curve) => curve.mean.some((value) => value !== null));

/** The knee first; angles, then moments, then powers. */
function rank(quantity: string): number {
  const kind = quantity.endsWith("moment") ? 10 : quantity.endsWith("power") ? 20 : 0;
  return kind + ["knee", "hip", "ankle"].findIndex((joint) => quantity.startsWith(joint));
}

interface PlotProps {
  chart: Chart;
  clock: Clock;
  toTime: (x: number) => number | null;
  fromTime: (time_s: number) => number | null;
  events: GaitEvent[];
}

function Plot({ chart, clock, toTime, fromTime, events }: PlotProps) {
  const place = useRef<HTMLDivElement>(null);
  const told = useRef<HTMLOutputElement>(null);
  useEffect(() => {
    const host = place.current!;
    const line = document.createElement("div");
    line.className = "moment-line";
    const shown = thinned(chart);
    const plot = new uPlot(
      {
        width: Math.max(host.clientWidth, 200),
        height: HEIGHT,
        title: chart.title,
        scales: { x: { time: false } },
        legend: { show: false },
        cursor: { y: false, drag: { x: false, y: false }, points: { size: 6 } },
        ...seriesOf(chart),
        axes: [
          { size: 26, font: "11px system-ui", values: (_: uPlot, ticks: number[]) => ticks.map((tick) => (chart.x === PERCENT ? `${tick} %` : `${tick} s`)) },
          { size: 42, font: "11px system-ui" },
        ],
        hooks: {
          setCursor: [
            (self: uPlot) => {
              if (self.cursor.left === undefined || self.cursor.left < 0 || clock.playing.value || !hovered(self)) return;
              const time = toTime(self.posToVal(self.cursor.left, "x"));
              if (time !== null) clock.seek(time);
            },
          ],
          drawClear: [(self: uPlot) => shade(self, clock.meant.value, fromTime)],
          draw: [(self: uPlot) => mark(self, events)],
          setSize: [() => placeLine()],
        },
      },
      dataOf(shown),
      host,
    );
    plot.over.append(line);
    // The clock moves an element over the plot: to draw all curves again for each moment would take too long.
    const placeLine = () => {
      if (!told.current) return; // uPlot tells of its size a little later, maybe after the page has gone
      const cursor = fromTime(clock.time_s.peek());
      const left = cursor === null ? -1 : plot.valToPos(cursor, "x");
      line.hidden = left < 0 || left > plot.over.clientWidth;
      line.style.transform = `translateX(${left}px)`;
      told.current.textContent = cursor === null ? "" : tell(chart, cursor);
    };
    const stopLine = effect(() => {
      void clock.time_s.value;
      placeLine();
    });
    let first = true;
    const stopShade = effect(() => {
      void clock.meant.value;
      if (!first) plot.redraw(false, false);
      first = false;
    });
    const fit = new ResizeObserver(() => plot.setSize({ width: Math.max(host.clientWidth, 200), height: HEIGHT }));
    fit.observe(host);
    return () => {
      stopLine();
      stopShade();
      fit.disconnect();
      plot.destroy();
    };
  }, [chart.title, chart.extra.length]);
  return (
    <figure class={isMeant(chart, clock.meant.value) ? "curve meant" : "curve"} aria-label={`${chart.title}: ${describe(chart)}`} role="img">
      <div ref={place} />
      <output ref={told} aria-live="off" />
    </figure>
  );
}

/** Whether a chart is of the joint that a finding speaks of: `right knee`, `Knee flexion, degrees …`. */
function isMeant(chart: Chart, meant: Meant | null): boolean {
  const joint = meant?.joint.split(" ").at(-1);
  return Boolean(joint) && chart.title.toLowerCase().startsWith(joint!);
}

/** Shade the stretch that a finding speaks of. */
function shade(plot: uPlot, meant: Meant | null, fromTime: PlotProps["fromTime"]) {
  if (!meant) return;
  const [start, end] = [fromTime(meant.start_s), fromTime(meant.end_s)];
  if (start === null || end === null) return;
  const { ctx, bbox } = plot;
  const clamp = (x: number) => Math.min(Math.max(plot.valToPos(x, "x", true), bbox.left), bbox.left + bbox.width);
  const [left, right] = [clamp(start), clamp(end)];
  ctx.save();
  ctx.fillStyle = "#f0e44266";
  ctx.fillRect(left, bbox.top, right - left, bbox.height);
  ctx.restore();
}

const hovered = (plot: uPlot) => plot.over.matches(":hover");

function seriesOf(chart: Chart): Pick<uPlot.Options, "series" | "bands"> {
  const series: uPlot.Series[] = [{}];
  const bands: uPlot.Band[] = [];
  for (const one of chart.extra) {
    series.push({ stroke: "transparent", points: { show: false } }, { stroke: "transparent", points: { show: false } });
    bands.push({ series: [series.length - 2, series.length - 1], fill: one.fill });
    if (one.middle) series.push({ stroke: one.colour, width: 1.5, dash: one.dash, points: { show: false } });
  }
  for (const line of chart.lines) {
    series.push({ stroke: "transparent", points: { show: false } }, { stroke: "transparent", points: { show: false } });
    bands.push({ series: [series.length - 2, series.length - 1], fill: `${COLOURS[line.side]}2e` });
    series.push({ label: line.side, stroke: COLOURS[line.side], width: 2, dash: line.side === "left" ? [8, 4] : undefined, points: { show: false } });
  }
  return { series, bands };
}

/**
 * Leave out what no screen can show: of each bucket of samples, all lines' lowest and highest values stay, and where
 * something begins or ends to be unknown.
 */
function thinned(chart: Chart): Chart {
  const size = chart.x.length;
  if (size <= 3 * BUCKETS || chart.extra.length > 0) return chart;
  const kept = new Set<number>([0, size - 1]);
  for (const { values } of chart.lines) {
    for (let bucket = 0; bucket < BUCKETS; bucket++) {
      const [start, end] = [Math.floor((bucket * size) / BUCKETS), Math.floor(((bucket + 1) * size) / BUCKETS)];
      let [low, high] = [-1, -1];
      for (let i = start; i < end; i++) {
        const value = values[i];
        if (i > 0 && (value == null) !== (values[i - 1] == null)) kept.add(i).add(i - 1);
        if (value == null) continue;
        if (low < 0 || value < values[low]!) low = i;
        if (high < 0 || value > values[high]!) high = i;
      }
      if (low >= 0) kept.add(low).add(high);
    }
  }
  const order = [...kept].sort((a, b) => a - b);
  const pick = <T,>(values: T[]): T[] => order.map((i) => values[i]!);
  return { ...chart, x: pick(chart.x), lines: chart.lines.map((line) => ({ ...line, values: pick(line.values), band: pick(line.band) })) };
}

function dataOf(chart: Chart): uPlot.AlignedData {
  const columns: Series[] = [];
  for (const one of chart.extra) columns.push(one.high, one.low, ...(one.middle ? [one.middle] : []));
  for (const line of chart.lines) columns.push(add(line.values, line.band, 1), add(line.values, line.band, -1), line.values);
  return [chart.x, ...columns] as uPlot.AlignedData;
}

/** Draw the events over a plot. */
function mark(plot: uPlot, events: GaitEvent[]) {
  const { ctx, bbox } = plot;
  const vertical = (x: number, colour: string, dash: number[], width: number) => {
    const left = plot.valToPos(x, "x", true);
    if (left < bbox.left || left > bbox.left + bbox.width) return;
    ctx.beginPath();
    ctx.strokeStyle = colour;
    ctx.lineWidth = width;
    ctx.setLineDash(dash);
    ctx.moveTo(left, bbox.top);
    ctx.lineTo(left, bbox.top + bbox.height);
    ctx.stroke();
  };
  ctx.save();
  for (const event of events) vertical(event.time_s, `${COLOURS[event.side]}99`, event.kind === "toe-off" ? [3, 3] : [], devicePixelRatio);
  ctx.restore();
}

/** The values at a place, with half their 95 % bands. */
function tell(chart: Chart, x: number): string {
  const { x: grid, unit } = chart;
  const step = (grid.at(-1)! - grid[0]!) / (grid.length - 1);
  const index = Math.round((x - grid[0]!) / step);
  if (index < 0 || index >= grid.length) return "";
  const size = unit === "°" ? 0 : 2;
  return chart.lines
    .map(({ side, values, band }) => {
      const [value, half] = [values[index], band[index]];
      if (value == null) return `${side} –`;
      return `${side} ${fixed(value, size)}${half == null ? "" : ` ± ${half.toFixed(size)}`}${unit}`;
    })
    .join(", ");
}

/** The same in words, for screen readers. */
function describe(chart: Chart): string {
  return chart.lines
    .map(({ side, values }) => {
      const known = values.filter((value): value is number => value !== null);
      if (known.length === 0) return `${side} unknown`;
      const [low, high] = known.reduce(([a, b], value) => [Math.min(a, value), Math.max(b, value)], [Infinity, -Infinity]);
      return `${side} from ${low.toFixed(1)} to ${high.toFixed(1)}${chart.unit}`;
    })
    .join("; ");
}
