import { isActive } from "./job";
import type { Job, Session } from "../types";

/** Sessions with what became of them. */
export function Sessions({ sessions, jobs }: { sessions: Session[]; jobs: Job[] }) {
  return (
    <table>
      <thead>
        <tr>
          <th>Session</th>
          <th>Subject</th>
          <th>Made</th>
          <th>State</th>
        </tr>
      </thead>
      <tbody>
        {sessions.map((session) => (
          <SessionRow key={session.id} session={session} jobs={jobs.filter((job) => job.session === session.id)} />
        ))}
      </tbody>
    </table>
  );
}

function SessionRow({ session, jobs }: { session: Session; jobs: Job[] }) {
  const { code, mass_kg, stature_m, sex } = session.subject;
  const subject = [code, sex, mass_kg && `${mass_kg} kg`, stature_m && `${stature_m} m`].filter(Boolean).join(", ");
  return (
    <tr>
      <td>
        <a href={`#/sessions/${session.id}`}>{session.name || "unnamed"}</a>
      </td>
      <td>{subject || <span class="quiet">{session.kind === "articulated_object" ? "no person" : "not given"}</span>}</td>
      <td>{new Date(session.created_at).toLocaleString()}</td>
      <td>
        <StateOf jobs={jobs} />
      </td>
    </tr>
  );
}

/** What became of a session: how far its job is, its report, or why there is none. */
export function StateOf({ jobs }: { jobs: Job[] }) {
  const running = jobs.find(isActive);
  if (running) {
    const { progress } = running;
    return <span class="state doing">{progress ? `${progress.stage}, ${Math.round(100 * progress.fraction)} %` : "waiting"}</span>;
  }
  const done = jobs.find((job) => job.report);
  if (done) return <a href={`#/reports/${done.id}`}>report</a>;
  const last = jobs[0]?.state;
  return last === "failed" ? <span class="state failed">failed</span> : <span class="quiet">{last ?? "not started"}</span>;
}
