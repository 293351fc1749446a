import { useState } from "preact/hooks";
import { api, Problem } from "../api";
import { useLoaded } from "../load";
import type { Job } from "../types";
import { ProblemNote } from "./problem";

const WORDS = { todo: "waiting", doing: "running", succeeded: "done", failed: "failed", cancelled: "cancelled" };
export const isActive = (job: Job) => job.state === "todo" || job.state === "doing";

/** One job, live: how far it is, how long it takes, what came of it. */
export function JobRow({ job: first, onEnd }: { job: Job; onEnd?: () => void }) {
  const [failure, setFailure] = useState<Problem | null>(null);
  const { value, problem } = useLoaded(
    async () => {
      const job = isActive(first) ? await api.job(first.id) : first;
      if (!isActive(job) && isActive(first)) onEnd?.();
      return job;
    },
    first.id + first.state,
    isActive,
  );
  const job = value ?? first;
  const percent = Math.round(100 * (job.progress?.fraction ?? 0));
  const cancel = () => api.cancel(job.id).catch((error: Problem) => setFailure(error));
  return (
    <li class={`job ${job.state}`}>
      <div class="row">
        <span class={`state ${job.state}`}>{WORDS[job.state]}</span>
        <time dateTime={job.created_at}>{new Date(job.created_at).toLocaleString()}</time>
        {job.report && <a class="button" href={`#/reports/${job.id}`}>Open the report</a>}
        {job.calibration && <a class="button" href={`#/calibrations/${job.id}`}>Open the calibration</a>}
        {isActive(job) && <button onClick={cancel}>Cancel</button>}
      </div>
      {isActive(job) && (
        <div class="row">
          <progress max={100} value={job.state === "doing" ? percent : undefined} aria-label="Progress of the job" />
          <span aria-live="polite">
            {job.progress
              ? `${job.progress.stage}, ${percent} %${remaining(job.progress.remaining_s)}`
              : "waits for a free worker"}
          </span>
        </div>
      )}
      {job.problem && (
        <p class="problem">
          <strong>{job.problem.message}</strong> {job.problem.hint} <a href={job.problem.type}>{job.problem.code}</a>
        </p>
      )}
      <ProblemNote problem={failure ?? problem} />
    </li>
  );
}

function remaining(seconds: number | null): string {
  if (seconds === null) return "";
  return seconds < 90 ? `, about ${Math.ceil(seconds)} s left` : `, about ${Math.ceil(seconds / 60)} min left`;
}
