// Uploads of one session: several at once, each with its progress, tried again after a dropped connection.

import { signal } from "@preact/signals";
import { Problem } from "../api";

export interface Upload {
  file: File;
  sent: number;
  problem: Problem | null;
  state: "waiting" | "sending" | "done" | "failed";
}

const AT_ONCE = 3;
const RETRY_MS = 3000;
const TRIES = 20;

export class Uploads {
  readonly list = signal<Upload[]>([]);

  constructor(
    private readonly session: string,
    private readonly onDone: () => void,
  ) {}

  add(files: Iterable<File>) {
    const known = new Set(this.list.value.filter((one) => one.state !== "failed").map((one) => one.file.name));
    const fresh = [...files].filter((file) => !known.has(file.name));
    const kept = this.list.value.filter((one) => !fresh.some((file) => file.name === one.file.name));
    this.list.value = [...kept, ...fresh.map((file): Upload => ({ file, sent: 0, problem: null, state: "waiting" }))];
    this.next();
  }

  private change(file: File, values: Partial<Upload>) {
    this.list.value = this.list.value.map((one) => (one.file === file ? { ...one, ...values } : one));
  }

  private next() {
    const sending = this.list.value.filter((one) => one.state === "sending").length;
    for (const one of this.list.value.filter((each) => each.state === "waiting").slice(0, AT_ONCE - sending)) {
      this.change(one.file, { state: "sending" });
      void this.send(one.file);
    }
  }

  private async send(file: File) {
    for (let attempt = 1; ; attempt++) {
      try {
        await post(this.session, file, (sent) => this.change(file, { sent }));
        this.change(file, { state: "done", sent: file.size, problem: null });
        this.onDone();
        break;
      } catch (error) {
        const problem = error as Problem;
        this.change(file, { problem });
        if (attempt === TRIES || (problem.status !== 0 && problem.status < 500) || problem.status === 507) {
          this.change(file, { state: "failed" });
          break;
        }
        await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
      }
    }
    this.next();
  }
}

/** Send a file as a form; `fetch` has no progress of what is sent. */
function post(session: string, file: File, onSent: (bytes: number) => void): Promise<void> {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    const form = new FormData();
    form.append("file", file);
    request.open("POST", `/v1/sessions/${session}/files`);
    request.upload.onprogress = (event) => onSent(Math.min(event.loaded, file.size));
    request.onerror = () => reject(new Problem(0, "unreachable", "The connection was cut.", "The upload is tried again."));
    request.onload = () => {
      if (request.status < 300) return resolve();
      let told: { code?: string; detail?: string; hint?: string } = {};
      try {
        told = JSON.parse(request.responseText);
      } catch {
        // A proxy's page, not gonio's answer.
      }
      const detail = told.detail ?? `The service answered ${request.status}.`;
      reject(new Problem(request.status, told.code ?? "", detail, told.hint ?? ""));
    };
    request.send(form);
  });
}
