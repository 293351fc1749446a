import { api } from "../api";
import { useLoaded } from "../load";
import { ProblemNote } from "../parts/problem";
import type { ObjectMotion, ResultFile, Session } from "../types";
import { Downloads, ReportPage } from "./report";

/** What an analysis found: a person's movement, or that of a thing with joints. */
export function ResultPage({ id }: { id: string }) {
  const { value: session, problem } = useLoaded(async () => api.session((await api.job(id)).session), id);
  if (!session) return <ProblemNote problem={problem} />;
  return session.kind === "articulated_object" ? <ObjectPage id={id} session={session} /> : <ReportPage id={id} session={session} />;
}

function ObjectPage({ id, session }: { id: string; session: Session }) {
  const load = async (): Promise<[ObjectMotion, ResultFile[]]> => Promise.all([api.motion(id), api.reportFiles(id)]);
  const { value, problem } = useLoaded(load, id);
  if (!value) return <ProblemNote problem={problem} />;
  const [motion, files] = value;
  const page = files.find((file) => file.kind === "page");
  const unsure = motion.joints.filter((joint) => joint.ambiguous || joint.pictures.some((picture) => picture.unsure));
  return (
    <article class="report">
      <header class="row">
        <h1>
          <a href={`#/sessions/${session.id}`}>{session.name || "Unnamed session"}</a>
        </h1>
        <p class="verdict">
          {motion.joints.length} of {motion.joints.length + motion.refused.length} parts solved
          {unsure.length > 0 && `; unsure: ${unsure.map((joint) => joint.part).join(", ")}`}. Turns are against the picture “{motion.reference}”.
        </p>
        {page && (
          <a class="button primary" href={page.url} target="_blank" rel="noopener">
            Page with all numbers
          </a>
        )}
      </header>
      <ul class="findings">
        {motion.refused.map((part) => (
          <li key={part.part} class="serious">
            <span class="tag">Refused</span>
            <div>
              <p>{part.message}</p>
              <p class="quiet">{part.hint}</p>
            </div>
          </li>
        ))}
      </ul>
      <h2>How each part turned</h2>
      <table>
        <thead>
          <tr>
            <th>Part</th>
            <th>Joint</th>
            <th>Turn in each picture, ± one standard deviation</th>
            <th>Noise of the marks</th>
          </tr>
        </thead>
        <tbody>
          {motion.joints.map((joint) => (
            <tr key={joint.part}>
              <td>
                {joint.part}
                {joint.parent && ` on ${joint.parent}`}
              </td>
              <td>
                {joint.joint}
                {joint.found_to_be_a_hinge && ", found to be a hinge"}
                {joint.ambiguous && "; another motion explains the pictures nearly as well"}
              </td>
              <td>
                {joint.pictures.filter((one) => one.picture !== motion.reference).map((one) => (
                  <div key={one.picture}>
                    {one.picture}: {one.turn_deg.toFixed(2)} ± {one.turn_sd_deg.toFixed(2)}°{one.unsure && " (unsure)"}
                  </div>
                ))}
              </td>
              <td>{joint.noise_px.toFixed(2)} px</td>
            </tr>
          ))}
        </tbody>
      </table>
      <h2>Files</h2>
      <Downloads files={files} />
    </article>
  );
}
