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
  const done = jobs.find((job) => job.report);
  const running = jobs.find(isActive);
  return (
    <tr>
      <td>
        <a href={`#/sessions/${session.id}`}>{session.name || "unnamed"}</a>
      </td>
      <td>{subject || <span class="quiet">not given</span>}</td>
      <td>{new Date(session.created_at).toLocaleString()}</td>
      <td>
        {running ? (
          <span class="state doing">
            {running.progress ? `${running.progress.stage}, ${Math.round(100 * running.progress.fraction)} %` : "waiting"}
          </span>
        ) : done ? (
          <a href={`#/reports/${done.id}`}>report</a>
        ) : (
          <span class="quiet">{jobs[0]?.state ?? "not analysed"}</span>
        )}
      </td>
    </tr>
  );
}
