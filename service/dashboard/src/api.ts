// The way to the REST API. The browser keeps the key in a cookie that no script can read (POST /sign-in sets it).

import type { ParameterSchema } from "./parts/options";
import type { Calibration, Caller, Job, ObjectMotion, Report, ResultFile, Session, Subject, UploadedFile } from "./types";

export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly code: string,
    message: string,
    readonly hint: string,
  ) {
    super(message);
  }
}

async function ask(method: string, path: string, body?: unknown, headers: Record<string, string> = {}): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(path, {
      method,
      headers: body === undefined ? headers : { ...headers, "content-type": "application/json" },
      body: body === undefined ? undefined : JSON.stringify(body),
    });
  } catch {
    throw new Problem(0, "unreachable", "The service can't be reached.", "The page tries again by itself.");
  }
  if (!response.ok) {
    const problem = await response.json().catch(() => ({}));
    throw new Problem(
      response.status,
      problem.code ?? "",
      problem.detail ?? `The service answered ${response.status}.`,
      problem.hint ?? "",
    );
  }
  return response;
}

async function json<T>(method: string, path: string, body?: unknown): Promise<T> {
  return (await ask(method, path, body)).json();
}

async function all<T>(path: string): Promise<T[]> {
  const items: T[] = [];
  for (let cursor: string | null = ""; cursor !== null; ) {
    const query = `${path}${path.includes("?") ? "&" : "?"}limit=200${cursor && `&cursor=${encodeURIComponent(cursor)}`}`;
    const page: { items: T[]; next_cursor: string | null } = await json("GET", query);
    items.push(...page.items);
    cursor = page.next_cursor;
  }
  return items;
}

export const api = {
  caller: () => json<Caller>("GET", "/v1/caller"),
  signIn: (key: string) => ask("POST", "/sign-in", { key }),
  signOut: () => ask("POST", "/sign-out"),
  sessions: (subject?: string) => all<Session>(subject === undefined ? "/v1/sessions" : `/v1/sessions?subject=${encodeURIComponent(subject)}`),
  session: (id: string) => json<Session>("GET", `/v1/sessions/${id}`),
  createSession: (values: { kind: string; name: string; subject: Subject; calibration: string | null }) =>
    json<Session>("POST", "/v1/sessions", values),
  deleteSession: (id: string) => ask("DELETE", `/v1/sessions/${id}`),
  files: (session: string) => all<UploadedFile>(`/v1/sessions/${session}/files`),
  deleteFile: (session: string, id: string) => ask("DELETE", `/v1/sessions/${session}/files/${id}`),
  analyse: (session: string, parameters: unknown) =>
    json<Job>("POST", `/v1/sessions/${session}/analyses`, { parameters }),
  parameters: async () => (await json<{ analysis: ParameterSchema }>("GET", "/v1/parameters")).analysis,
  jobs: (session?: string) => all<Job>(session ? `/v1/jobs?session=${session}` : "/v1/jobs"),
  job: (id: string) => json<Job>("GET", `/v1/jobs/${id}`),
  cancel: (id: string) => json<Job>("POST", `/v1/jobs/${id}/cancel`),
  report: (id: string) => json<Report>("GET", `/v1/reports/${id}`),
  motion: (id: string) => json<ObjectMotion>("GET", `/v1/reports/${id}`),
  reportFiles: async (id: string) => (await json<{ items: ResultFile[] }>("GET", `/v1/reports/${id}/files`)).items,
  calibrations: () => all<Calibration>("/v1/calibrations"),
  calibration: (id: string) => json<Calibration>("GET", `/v1/calibrations/${id}`),
  document: <T>(url: string) => json<T>("GET", url),
  /** Some of a file's 32-bit floats: `size` of them from number `offset` on. */
  numbers: async (url: string, offset: number, size: number) => {
    const range = `bytes=${4 * offset}-${4 * (offset + size) - 1}`;
    const answer = await ask("GET", url, undefined, { range });
    const numbers = new Float32Array(await answer.arrayBuffer());
    return answer.status === 206 ? numbers : numbers.subarray(offset, offset + size);
  },
};
