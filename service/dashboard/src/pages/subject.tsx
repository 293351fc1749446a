import { useState } from "preact/hooks";
import { api } from "../api";
import { useLoaded } from "../load";
import { isActive } from "../parts/job";
import { ProblemNote } from "../parts/problem";
import { Sessions } from "../parts/sessions";
import type { Job, Session } from "../types";

/** One subject: their sessions, and the reports of these, two of which can be compared. */
export function SubjectPage({ code }: { code: string }) {
  const load = async (): Promise<{ sessions: Session[]; jobs: Job[] }> => {
    const [sessions, jobs] = await Promise.all([api.sessions(code), api.jobs()]);
    return { sessions, jobs: jobs.filter((job) => sessions.some((session) => session.id === job.session)) };
  };
  const { value, problem } = useLoaded(load, code, (found) => found.jobs.some(isActive), 2000);
  const [chosen, setChosen] = useState<string[]>([]);
  if (!value) return <ProblemNote problem={problem} />;
  const reports = value.jobs.filter((job) => job.report);
  const nameOf = (job: Job) => value.sessions.find((session) => session.id === job.session)?.name || "unnamed";
  const toggle = (id: string) => setChosen(chosen.includes(id) ? chosen.filter((one) => one !== id) : [...chosen.slice(-1), id]);
  // The older one first: what changed since is what people ask for.
  const pair = reports.filter((job) => chosen.includes(job.id)).reverse();
  return (
    <>
      <ProblemNote problem={problem} />
      <div class="row">
        <h1>Subject {code}</h1>
        <a class="button primary" href={`#/new/human_multicamera/${encodeURIComponent(code)}`}>
          New session
        </a>
      </div>
      {value.sessions.length === 0 ? (
        <p class="empty">No session of this subject. Give the code “{code}” with a new session, and it stands here.</p>
      ) : (
        <Sessions sessions={value.sessions} jobs={value.jobs} />
      )}
      <h2>Trials</h2>
      {reports.length === 0 ? (
        <p class="empty">No report yet. Open a session, upload what was recorded, and analyse it.</p>
      ) : (
        <>
          <ul class="trials">
            {reports.map((job) => (
              <li key={job.id}>
                <label>
                  <input type="checkbox" checked={chosen.includes(job.id)} onChange={() => toggle(job.id)} /> {nameOf(job)}, analysed{" "}
                  {new Date(job.created_at).toLocaleString()}
                </label>
                <a href={`#/reports/${job.id}`}>Open</a>
              </li>
            ))}
          </ul>
          {pair.length === 2 ? (
            <a class="button primary" href={`#/compare/${pair[0]!.id}/${pair[1]!.id}`}>
              Compare these two
            </a>
          ) : (
            reports.length > 1 && <p class="quiet">Choose two of them to compare.</p>
          )}
        </>
      )}
    </>
  );
}
