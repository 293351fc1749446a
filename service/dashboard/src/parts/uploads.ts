// Uploads of one session: several at once, each with its progress; after a cut, each goes on from where the service stands.

import { signal } from "@preact/signals";
import { DetailedError, Upload as Tus } from "tus-js-client";
import { Problem } from "../api";

export interface Upload {
  file: File;
  /** What it is called there: a role that its name doesn't tell stands before it. */
  name: string;
  role: string;
  sent: number;
  problem: Problem | null;
  state: "waiting" | "sending" | "done" | "failed";
}

const AT_ONCE = 3;
const RETRY_MS = 3000;
const TRIES = 20;
const LOCKED = 423; // by the request that was cut, until the service notices
const FULL = 507;

export class Uploads {
  readonly list = signal<Upload[]>([]);

  constructor(
    private readonly session: string,
    private readonly onDone: () => void,
  ) {}

  /** Send files; where a name doesn't tell what a file is, `roleOf` does. */
  add(files: Iterable<File>, roleOf: (file: File) => string) {
    const known = new Set(this.list.value.filter((one) => one.state !== "failed").map((one) => one.name));
    const all = [...files].map((file): Upload => {
      const role = roleOf(file);
      return { file, role, name: role ? `${role}-${file.name}` : file.name, sent: 0, problem: null, state: "waiting" };
    });
    const fresh = all.filter((one) => !known.has(one.name));
    const kept = this.list.value.filter((one) => !fresh.some((other) => other.name === one.name));
    this.list.value = [...kept, ...fresh];
    this.next();
  }

  private change(file: File, values: Partial<Upload>) {
    this.list.value = this.list.value.map((one) => (one.file === file ? { ...one, ...values } : one));
  }

  private next() {
    const sending = this.list.value.filter((one) => one.state === "sending").length;
    for (const one of this.list.value.filter((each) => each.state === "waiting").slice(0, AT_ONCE - sending)) {
      this.change(one.file, { state: "sending" });
      this.send(one);
    }
  }

  private send({ file, name, role }: Upload) {
    const ended = (values: Partial<Upload>) => {
      this.change(file, values);
      this.next();
    };
    new Tus(file, {
      endpoint: `/v1/sessions/${this.session}/uploads`,
      metadata: { filename: name, ...(role && { role, camera: file.name.replace(/\.[^.]*$/, "") }) },
      retryDelays: Array<number>(TRIES).fill(RETRY_MS),
      storeFingerprintForResuming: false,
      onProgress: (sent) => this.change(file, { sent }),
      onShouldRetry: (error) => {
        const problem = problemOf(error);
        this.change(file, { problem });
        return problem.status === 0 || problem.status === LOCKED || (problem.status >= 500 && problem.status !== FULL);
      },
      onError: (error) => ended({ state: "failed", problem: problemOf(error) }),
      onSuccess: () => {
        ended({ state: "done", sent: file.size, problem: null });
        this.onDone();
      },
    }).start();
  }
}

/** Tell in the service's words what went wrong, if it said a word. */
function problemOf(error: Error): Problem {
  const answer = error instanceof DetailedError ? error.originalResponse : null;
  if (!answer) return new Problem(0, "unreachable", "The connection was cut.", "The upload goes on by itself.");
  let told: { code?: string; detail?: string; hint?: string } = {};
  try {
    told = JSON.parse(answer.getBody());
  } catch {
    // A proxy's page, not gonio's answer.
  }
  const detail = told.detail ?? `The service answered ${answer.getStatus()}.`;
  return new Problem(answer.getStatus(), told.code ?? "", detail, told.hint ?? "");
}
