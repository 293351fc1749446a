import { api } from "../api";
import { useLoaded } from "../load";
import { isActive } from "../parts/job";
import { ProblemNote } from "../parts/problem";
import type { Calibration, Job, Session } from "../types";

const VERDICTS = { accept: "accepted", warn: "accepted with warnings", reject: "rejected" };

interface Overview {
  sessions: Session[];
  jobs: Job[];
  calibrations: Calibration[];
}

export function HomePage() {
  const load = async (): Promise<Overview> => {
    const [sessions, jobs, calibrations] = await Promise.all([api.sessions(), api.jobs(), api.calibrations()]);
    return { sessions, jobs, calibrations };
  };
  const { value, problem } = useLoaded(load, "home", (found) => found.jobs.some(isActive), 2000);
  if (!value) return <ProblemNote problem={problem} />;
  const trials = value.sessions.filter((session) => session.kind !== "calibration");
  return (
    <>
      <ProblemNote problem={problem} />
      <div class="row">
        <h1>Sessions</h1>
        <a class="button primary" href="#/new">
          New session
        </a>
        <a class="button" href="#/new/calibration">
          Calibrate cameras
        </a>
      </div>
      {trials.length === 0 ? (
        <p class="empty">
          No session yet. A session holds the videos of one trial, with the cameras' calibration and, if there are any, the
          pressure soles. <code>gonio demo</code> makes an example.
        </p>
      ) : (
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
            {trials.map((session) => (
              <SessionRow key={session.id} session={session} jobs={value.jobs.filter((job) => job.session === session.id)} />
            ))}
          </tbody>
        </table>
      )}
      <h2>Calibrations</h2>
      {value.calibrations.length === 0 ? (
        <p class="empty">None yet. Film a printed board with all cameras, then calibrate them; or upload a calibration with a session.</p>
      ) : (
        <table>
          <thead>
            <tr>
              <th>Rig</th>
              <th>Cameras</th>
              <th>Made</th>
              <th>Verdict</th>
            </tr>
          </thead>
          <tbody>
            {value.calibrations.map((calibration) => (
              <tr key={calibration.id}>
                <td>
                  <a href={`#/calibrations/${calibration.id}`}>{calibration.name || "unnamed"}</a>
                </td>
                <td>{calibration.cameras.join(", ")}</td>
                <td>{new Date(calibration.created_at).toLocaleString()}</td>
                <td>
                  <span class={`state ${calibration.verdict}`}>{VERDICTS[calibration.verdict]}</span>
                </td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
    </>
  );
}

function SessionRow({ session, jobs }: { session: Session; jobs: Job[] }) {
  const { mass_kg, stature_m, sex } = session.subject;
  const subject = [sex, mass_kg && `${mass_kg} kg`, stature_m && `${stature_m} m`].filter(Boolean).join(", ");
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
