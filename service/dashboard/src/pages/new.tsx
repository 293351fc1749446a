import { useState } from "preact/hooks";
import { api, Problem } from "../api";
import { useLoaded } from "../load";
import { ProblemNote } from "../parts/problem";

/** `code`: of a subject who was here before; what is known of them stands in the form already. */
export function NewSessionPage({ kind, code }: { kind: string; code: string }) {
  const { value: before } = useLoaded(async () => (code ? ((await api.sessions(code))[0]?.subject ?? null) : null), code);
  const [problem, setProblem] = useState<Problem | null>(null);
  const { value: calibrations } = useLoaded(api.calibrations, "calibrations");
  const [cameras, setCameras] = useState(kind);
  const isTrial = kind !== "calibration";
  const isObject = cameras === "articulated_object";
  const submit = async (event: SubmitEvent) => {
    event.preventDefault();
    const form = new FormData(event.currentTarget as HTMLFormElement);
    const text = (name: string) => String(form.get(name) ?? "").trim();
    const number = (name: string) => (text(name) ? Number(text(name).replace(",", ".")) : null);
    try {
      const session = await api.createSession({
        kind: isTrial ? text("kind") : kind,
        name: text("name"),
        subject: isTrial && !isObject ? { code: text("code") || null, mass_kg: number("mass"), stature_m: number("stature"), sex: (text("sex") || null) as "female" | "male" | null } : {},
        calibration: text("calibration") || null,
      });
      location.hash = `#/sessions/${session.id}`;
    } catch (error) {
      setProblem(error as Problem);
    }
  };
  return (
    <div class="narrow">
      <h1>{isTrial ? "New session" : "Calibrate cameras"}</h1>
      <form onSubmit={submit}>
        <label>
          Name
          <input name="name" maxLength={200} placeholder={isTrial ? "Anna, barefoot, 2nd walk" : "Gait lab, November"} />
        </label>
        {isTrial && (
          <fieldset class="choice">
            <legend>Filmed by</legend>
            <label>
              <input type="radio" name="kind" value="human_multicamera" checked={cameras === "human_multicamera"} onChange={() => setCameras("human_multicamera")} />
              several cameras, at once
            </label>
            <label>
              <input type="radio" name="kind" value="human_monocular" checked={cameras === "human_monocular"} onChange={() => setCameras("human_monocular")} />
              one camera
            </label>
            <label>
              <input type="radio" name="kind" value="articulated_object" checked={isObject} onChange={() => setCameras("articulated_object")} />
              one moving camera, a few photographs of a thing with joints
            </label>
            {isObject && (
              <p class="quiet">
                No person: an excavator, a mannequin. You upload its joint tree (body.toml), marks in the photographs (tracks.csv), and what tells where
                the camera was.
              </p>
            )}
            {cameras === "human_monocular" && (
              <p class="quiet">
                Film straight from the side, with a camera whose lens and place over the floor are calibrated. All lengths rest on the stature. One
                camera gives angles with wider bands than several.
              </p>
            )}
          </fieldset>
        )}
        {isTrial && (
          <fieldset hidden={isObject} disabled={isObject}>
            <legend>Subject</legend>
            <label>
              Code
              <input name="code" maxLength={100} defaultValue={code} placeholder="P07" aria-describedby="code-why" />
            </label>
            <p id="code-why" class="quiet">
              The same in all sessions of a person, which then stand together. A pseudonym, not a name.
            </p>
            <label>
              Mass, kg
              <input name="mass" defaultValue={before?.mass_kg ?? ""} inputMode="decimal" pattern="[0-9]+([.,][0-9]+)?" aria-describedby="mass-why" />
            </label>
            <p id="mass-why" class="quiet">
              Without it, there are angles but no torques.
            </p>
            <label>
              Stature, m
              <input name="stature" defaultValue={before?.stature_m ?? ""} inputMode="decimal" pattern="[0-9]+([.,][0-9]+)?" required={cameras === "human_monocular"} />
            </label>
            <label>
              Sex
              <select name="sex">
                <option value="">not given</option>
                <option value="female" selected={before?.sex === "female"}>female</option>
                <option value="male" selected={before?.sex === "male"}>male</option>
              </select>
            </label>
          </fieldset>
        )}
        {!isObject && (
          <label>
            {isTrial ? "Calibration of the cameras" : "Earlier calibration to check"}
            <select name="calibration">
              <option value="">{isTrial ? "I upload a file of it" : "none"}</option>
              {calibrations?.map((one) => (
                <option key={one.id} value={one.id}>
                  {one.name || one.cameras.join(", ")} · {new Date(one.created_at).toLocaleDateString()} · {one.verdict}
                </option>
              ))}
            </select>
          </label>
        )}
        <button class="primary">Create</button>
        <ProblemNote problem={problem} />
      </form>
    </div>
  );
}
