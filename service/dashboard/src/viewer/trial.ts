// The movement of one report: viewer.json and viewer.f32 (docs/reference/viewer.md), and where things are at a moment.

import { signal } from "@preact/signals";
import { api } from "../api";
import type { Report, ResultFile } from "../types";

export interface View {
  name: string;
  width_px: number;
  height_px: number;
  intrinsic_px: number[][];
  distortion: number[];
  T_cam_lab: number[][];
  delay_s: number;
  preview: string | null;
}

interface Header {
  rate_hz: number;
  start_s: number;
  frames: number;
  keypoints: string[];
  lines: [number, number][];
  markers: string[];
  marker_lines: [number, number][];
  cameras: View[];
  weight_n: number;
  arrays: Record<string, { offset: number; shape: number[] }>;
}

export type Point = [number, number, number];

export class Trial {
  /** Counts the parts of the numbers that have come: what is drawn is drawn again. */
  readonly arrived = signal(0);

  constructor(
    readonly report: Report,
    readonly files: ResultFile[],
    readonly header: Header,
    private readonly numbers: Float32Array,
  ) {}

  get duration_s(): number {
    return (this.header.frames - 1) / this.header.rate_hz;
  }

  /** The frame nearest to a moment, from 0. */
  frameAt(time_s: number): number {
    const frame = Math.round((time_s - this.header.start_s) * this.header.rate_hz);
    return Math.min(Math.max(frame, 0), this.header.frames - 1);
  }

  /** One row of an array: its last dimension's values for the given indices of the others; null if it is not known. */
  row(name: string, ...index: number[]): number[] | null {
    const where = this.header.arrays[name];
    if (!where) return null;
    let offset = 0;
    index.forEach((at, axis) => (offset = offset * where.shape[axis]! + at));
    const size = where.shape[index.length] ?? 1;
    const start = where.offset + offset * size;
    const values = Array.from(this.numbers.subarray(start, start + size));
    return values.every(Number.isFinite) ? values : null;
  }

  point(name: "points" | "markers" | "force" | "cop", frame: number, index: number): Point | null {
    return this.row(name, frame, index) as Point | null;
  }

  has(name: string): boolean {
    return name in this.header.arrays;
  }

  url(name: string): string | null {
    return this.files.find((file) => file.name === name)?.url ?? null;
  }
}

const FIRST = ["markers", "force", "cop"]; // the body and the forces; the rest, much more, may come a little later

/** Load a trial: at once what is seen first, the rest while it is looked at. Until then it is unknown, NaN. */
export async function loadTrial(id: string): Promise<Trial> {
  const base = `/v1/reports/${id}/files`;
  const asked = Promise.all([api.report(id), api.reportFiles(id)]);
  asked.catch(() => undefined); // told below, if the header doesn't fail first
  const header = await api.document<Header>(`${base}/viewer.json`);
  const sizes = Object.entries(header.arrays).map(([name, { offset, shape }]) => {
    return { name, offset, size: shape.reduce((all, one) => all * one, 1) };
  });
  const numbers = new Float32Array(Math.max(0, ...sizes.map(({ offset, size }) => offset + size))).fill(NaN);
  const fetchPart = async ({ offset, size }: { offset: number; size: number }) => {
    if (size > 0) numbers.set(await api.numbers(`${base}/viewer.f32`, offset, size), offset);
  };
  const first = sizes.filter(({ name }) => FIRST.includes(name));
  const [[report, files]] = await Promise.all([asked, ...first.map(fetchPart)]);
  const trial = new Trial(report, files, header, numbers);
  for (const part of sizes.filter(({ name }) => !FIRST.includes(name))) {
    void fetchPart(part).then(
      () => (trial.arrived.value += 1),
      () => undefined, // what didn't come stays unknown; the page shows the rest
    );
  }
  return trial;
}
