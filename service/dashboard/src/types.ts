// What the REST API gives, as far as the page reads it (GET /docs has all of it).

export type Series = (number | null)[];
export type Side = "right" | "left";
export type Severity = "info" | "warning" | "serious";

export interface Subject {
  code?: string | null;
  mass_kg?: number | null;
  stature_m?: number | null;
  sex?: "female" | "male" | null;
}

export interface Session {
  id: string;
  kind: string;
  name: string;
  subject: Subject;
  calibration: string | null;
  created_at: string;
}

export interface UploadedFile {
  id: string;
  name: string;
  role: string;
  camera: string | null;
  size: number;
  facts: Record<string, unknown>;
}

export interface Job {
  id: string;
  session: string;
  state: "todo" | "doing" | "succeeded" | "failed" | "cancelled";
  progress: { stage: string; fraction: number; remaining_s: number | null } | null;
  problem: { code: string; message: string; hint: string; type: string } | null;
  report: string | null;
  calibration: string | null;
  created_at: string;
  ended_at: string | null;
}

export interface ResultFile {
  name: string;
  kind: "document" | "page" | "other";
  size: number;
  url: string;
}

export interface Finding {
  code: string;
  severity: Severity;
  stage: string;
  message: string;
  hint: string;
  where: string;
  /** The stretch of a trial that it speaks of, on the clock of `time_s`; null or left out: all of it. */
  start_s?: number | null;
  end_s?: number | null;
  camera?: string;
  joint?: string;
}

export interface Calibration {
  id: string;
  session: string;
  name: string;
  verdict: "accept" | "warn" | "reject";
  cameras: string[];
  left_out: string[];
  board: string;
  volume_error_mm: number | null;
  findings: Finding[];
  files: ResultFile[];
  created_at: string;
}

export interface Angle {
  joint: "hip" | "knee" | "ankle";
  side: Side;
  name: string;
  positive: string;
  values_deg: Series;
  sd_deg: Series;
}

export interface GaitEvent {
  side: Side;
  kind: "initial contact" | "toe-off";
  time_s: number;
}

export interface Cycle {
  side: Side;
  start_s: number;
  end_s: number;
  toe_off_percent: number | null;
  left_out: string;
}

export interface CycleCurve {
  quantity: string;
  joint: string;
  side: Side;
  name: string;
  unit: string;
  positive: string;
  cycles: Series[];
  mean: Series;
  error_sd: Series;
  norm: { source: string; condition: string; mean: Series; sd: Series } | null;
}

export interface Torque {
  joint: "hip" | "knee" | "ankle";
  side: Side;
  positive: string;
  values_nm: Series;
  band_nm: Series;
  values_nm_kg: Series;
}

export interface Parameter {
  name: string;
  unit: string;
  both: { mean: number; sd: number | null } | null;
  right: { mean: number; sd: number | null } | null;
  left: { mean: number; sd: number | null } | null;
  usual: number | null;
}

export interface Report {
  created: string;
  verdict: { level: "good" | "usable" | "poor"; sentence: string };
  findings: Finding[];
  rate_hz: number;
  frames: number;
  duration_s: number;
  time_s: number[];
  angles: Angle[];
  gait: { events: GaitEvent[]; cycles: Cycle[]; curves: CycleCurve[]; parameters: Parameter[] };
  kinetics: { torques: Torque[]; expected_error_nm_kg: number | null } | null;
  body: { mass_kg: number };
}

/** What the pictures told of an articulated object (docs/reference/articulated.schema.json). */
export interface ObjectMotion {
  reference: string;
  joints: {
    part: string;
    parent: string | null;
    joint: string;
    found_to_be_a_hinge: boolean;
    ambiguous: boolean;
    noise_px: number;
    pictures: { picture: string; turn_deg: number; turn_sd_deg: number; unsure: boolean }[];
  }[];
  refused: { part: string; code: string; message: string; hint: string }[];
}

export interface Caller {
  lab: string;
  scopes: string[];
  signed_in: boolean;
}
