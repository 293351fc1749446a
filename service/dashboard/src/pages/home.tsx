import { api } from "../api";
import { useLoaded } from "../load";
import { isActive } from "../parts/job";
import { Sessions, StateOf } from "../parts/sessions";
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
  const unfinished = value.sessions.filter(
    (session) => session.kind === "calibration" && !value.calibrations.some((calibration) => calibration.session === session.id),
  );
  const trials = value.sessions.filter((session) => session.kind !== "calibration");
  const subjects = [...new Set(trials.map((session) => session.subject.code).filter((code): code is string => Boolean(code)))].sort();
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
      {subjects.length > 0 && (
        <>
          <h2>Subjects</h2>
          <table>
            <thead>
              <tr>
                <th>Subject</th>
                <th>Sessions</th>
                <th>Reports</th>
                <th>Last one</th>
              </tr>
            </thead>
            <tbody>
              {subjects.map((code) => {
                const own = trials.filter((session) => session.subject.code === code);
                const reports = value.jobs.filter((job) => job.report && own.some((session) => session.id === job.session));
                return (
                  <tr key={code}>
                    <td>
                      <a href={`#/subjects/${encodeURIComponent(code)}`}>{code}</a>
                    </td>
                    <td>{own.length}</td>
                    <td>{reports.length}</td>
                    <td>{new Date(own[0]!.created_at).toLocaleDateString()}</td>
                  </tr>
                );
              })}
            </tbody>
          </table>
          <h2>All sessions</h2>
        </>
      )}
      {trials.length === 0 ? (
        <p class="empty">
          No session yet. A session holds the videos of one trial, with the cameras' calibration and, if there are any, the
          pressure soles. <code>gonio demo</code> makes an example.
        </p>
      ) : (
        <Sessions sessions={trials} jobs={value.jobs} />
      )}
      <h2>Calibrations</h2>
      {value.calibrations.length + unfinished.length === 0 ? (
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
            {unfinished.map((session) => (
              <tr key={session.id}>
                <td>
                  <a href={`#/sessions/${session.id}`}>{session.name || "unnamed"}</a>
                </td>
                <td />
                <td>{new Date(session.created_at).toLocaleString()}</td>
                <td>
                  <StateOf jobs={value.jobs.filter((job) => job.session === session.id)} />
                </td>
              </tr>
            ))}
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
