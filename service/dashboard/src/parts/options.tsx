// What an analysis may be asked for: a form made from the service's own schema of it, simple at first, the rest folded.

import { useState } from "preact/hooks";
import { api } from "../api";
import { useLoaded } from "../load";
import { ProblemNote } from "./problem";

interface Property {
  type?: string;
  enum?: string[];
  anyOf?: Property[];
  default?: unknown;
  description?: string;
  $ref?: string;
}

export interface ParameterSchema {
  properties: Record<string, Property>;
  $defs: Record<string, { description?: string; properties: Record<string, Property> }>;
}

export type Chosen = Record<string, string>;

/** What most people change, by where it stands in the schema; all else is below "More". */
const SIMPLE = ["forces.task", "keypoints.rate"];

const WORDS: Record<string, string> = {
  "forces.task": "What the subject does",
  "keypoints.rate": "How closely the videos are looked at",
  "keypoints.model": "Network for the keypoints",
  "keypoints.layout": "Uploaded keypoints",
  "keypoints.rate_hz": "Rate of uploaded keypoints, Hz",
  "keypoints.person": "Who is the subject",
  "reconstruction.method": "Way from pictures to space",
  "reconstruction.min_confidence": "Least confidence of a keypoint",
  "reconstruction.synchronization": "Cameras' clocks",
  "reconstruction.refine_cameras": "Correct the cameras on the subject",
  "reconstruction.lab": "Floor and vertical",
  "reconstruction.smoothing": "Smoothing",
  "reconstruction.cutoff_hz": "Bandwidth of the tracks, Hz",
  "kinematics.method": "Joint angles from",
  "forces.method": "Shear under the feet",
  "forces.synchronization": "Soles' clock",
  "forces.search_s": "Offset of the soles' clock, s at most",
};

interface Field {
  path: string;
  choices: string[] | null;
  isNumber: boolean;
  standard: string;
  why: string;
}

/** Ask for what differs from the defaults. */
export function Options({ chosen, onChange }: { chosen: Chosen; onChange: (chosen: Chosen) => void }) {
  const [open, setOpen] = useState(false);
  const { value, problem } = useLoaded(async () => (open ? fieldsOf(await api.parameters()) : null), `options ${open}`);
  const ask = (field: Field) => (
    <Question key={field.path} field={field} value={chosen[field.path] ?? ""} onInput={(text) => onChange({ ...chosen, [field.path]: text })} />
  );
  const changed = Object.values(chosen).filter(Boolean).length;
  return (
    <details class="options" onToggle={(event) => event.target === event.currentTarget && setOpen(event.currentTarget.open)}>
      <summary>Options of the analysis{changed ? ` (${changed} changed)` : ""}</summary>
      <ProblemNote problem={problem} />
      {value && (
        <>
          <div class="questions">{SIMPLE.flatMap((path) => value.filter((field) => field.path === path)).map(ask)}</div>
          <details>
            <summary>More, for those who know why</summary>
            <div class="questions">{value.filter((field) => !SIMPLE.includes(field.path)).map(ask)}</div>
          </details>
          <button disabled={!changed} onClick={() => onChange({})}>
            Back to the defaults
          </button>
        </>
      )}
    </details>
  );
}

function Question({ field, value, onInput }: { field: Field; value: string; onInput: (text: string) => void }) {
  const id = field.path.replace(".", "-");
  const name = WORDS[field.path] ?? field.path;
  return (
    <div class="question">
      <label for={id}>{name}</label>
      {field.choices ? (
        <select id={id} value={value} aria-describedby={`${id}-why`} onChange={(event) => onInput(event.currentTarget.value)}>
          <option value="">{plain(field.standard || "not given")} (default)</option>
          {field.choices
            .filter((choice) => choice !== field.standard)
            .map((choice) => (
              <option key={choice} value={choice}>
                {plain(choice)}
              </option>
            ))}
        </select>
      ) : (
        <input
          id={id}
          inputMode={field.isNumber ? "decimal" : undefined}
          value={value}
          placeholder={field.standard || "not given"}
          aria-describedby={`${id}-why`}
          onInput={(event) => onInput(event.currentTarget.value)}
        />
      )}
      <p class="quiet" id={`${id}-why`}>
        {field.why.replace(/`/g, "").replace(/_/g, " ")}
      </p>
    </div>
  );
}

const plain = (word: string) => ({ true: "yes", false: "no", default: "30 Hz", exact: "60 Hz", fast: "20 Hz" })[word] ?? word.replace(/_/g, " ");

function fieldsOf(schema: ParameterSchema): Field[] {
  return Object.entries(schema.properties).flatMap(([part, { $ref }]) => {
    const group = schema.$defs[$ref?.split("/").at(-1) ?? ""];
    if (part === "subject" || !group) return []; // the subject is the session's
    return Object.entries(group.properties).map(([name, property]): Field => {
      const all = [property, ...(property.anyOf ?? [])];
      const choices = property.type === "boolean" ? ["true", "false"] : (all.find((one) => one.enum)?.enum ?? null);
      return {
        path: `${part}.${name}`,
        choices,
        isNumber: all.some((one) => one.type === "number"),
        standard: property.default == null ? "" : String(property.default),
        why: all.find((one) => one.description)?.description ?? "",
      };
    });
  });
}

/** Give the parameters of a request: `{forces: {task: "running"}}`. */
export function parametersOf(chosen: Chosen): Record<string, Record<string, unknown>> {
  const asked: Record<string, Record<string, unknown>> = {};
  for (const [path, text] of Object.entries(chosen)) {
    const [part, name] = path.split(".") as [string, string];
    if (text.trim()) (asked[part] ??= {})[name] = valueOf(text.trim());
  }
  return asked;
}

/** Numbers, yes and no, and two numbers (a place on the floor: `1.2 0.4`) as JSON has them; words as they are. */
function valueOf(text: string): unknown {
  if (text === "true" || text === "false") return text === "true";
  const numbers = text.replace(/(\d),(\d)/g, "$1.$2").split(/[\s,;]+/).map(Number);
  if (numbers.some(Number.isNaN)) return text;
  return numbers.length === 1 ? numbers[0] : numbers;
}
