import { useEffect, useState } from "preact/hooks";
import { api, Problem } from "../api";
import { useLoaded } from "../load";
import type { Job } from "../types";
import { ProblemNote } from "./problem";

const WORDS = { todo: "waiting", doing: "running", succeeded: "done", failed: "failed", cancelled: "cancelled" };
const SILENCE_MS = 15_000; // a job that waits or computes a long stage is silent: then asking does no harm
export const isActive = (job: Job) => job.state === "todo" || job.state === "doing";

/** Follow a job by the service's events; where they don't come through (a proxy that holds them back), ask every second. */
function useJob(first: Job, onEnd?: () => void): { job: Job; problem: Problem | null } {
  const [told, setTold] = useState<Job | null>(null);
  const [silent, setSilent] = useState(false);
  const active = isActive(first);
  useEffect(() => {
    if (!active) return;
    const events = new EventSource(`/v1/jobs/${first.id}/events`);
    const giveUp = () => {
      events.close();
      setSilent(true);
    };
    let patience = setTimeout(giveUp, SILENCE_MS);
    events.addEventListener("job", (event: MessageEvent<string>) => {
      clearTimeout(patience);
      const job: Job = JSON.parse(event.data);
      setTold(job);
      if (isActive(job)) patience = setTimeout(giveUp, SILENCE_MS);
      else {
        events.close();
        onEnd?.();
      }
    });
    events.onerror = giveUp;
    return () => {
      clearTimeout(patience);
      events.close();
    };
  }, [first.id, active]);
  const ask = async () => {
    const job = silent && active ? await api.job(first.id) : first;
    if (silent && active && !isActive(job)) onEnd?.();
    return job;
  };
  const { value, problem } = useLoaded(ask, `${first.id} ${first.state} ${silent}`, (job) => silent && isActive(job));
  return { job: active ? ((silent ? value : told) ?? told ?? first) : first, problem };
}

/** One job, live: how far it is, how long it takes, what came of it. */
export function JobRow({ job: first, onEnd }: { job: Job; onEnd?: () => void }) {
  const [failure, setFailure] = useState<Problem | null>(null);
  const { job, problem } = useJob(first, onEnd);
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
  if (seconds === null || seconds < 1) return ""; // it takes longer than was thought
  return seconds < 90 ? `, about ${Math.ceil(seconds)} s left` : `, about ${Math.ceil(seconds / 60)} min left`;
}
