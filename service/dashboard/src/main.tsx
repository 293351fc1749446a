import { render } from "preact";
import { useEffect, useState } from "preact/hooks";
import { api } from "./api";
import { useLoaded } from "./load";
import { CalibrationPage } from "./pages/calibration";
import { HomePage } from "./pages/home";
import { NewSessionPage } from "./pages/new";
import { ResultPage } from "./pages/object";
import { SessionPage } from "./pages/session";
import { ComparePage } from "./pages/compare";
import { SubjectPage } from "./pages/subject";
import { SignInPage } from "./pages/signin";
import { ProblemNote } from "./parts/problem";
import "./style.css";

function usePlace(): string[] {
  const read = () => location.hash.replace(/^#\/?/, "").split("/");
  const [place, setPlace] = useState(read);
  useEffect(() => {
    const follow = () => {
      setPlace(read());
      window.scrollTo(0, 0);
    };
    addEventListener("hashchange", follow);
    return () => removeEventListener("hashchange", follow);
  }, []);
  return place;
}

function Page({ place }: { place: string[] }) {
  const [what, id, other] = place;
  if (what === "new") return <NewSessionPage key={location.hash} kind={id || "human_multicamera"} code={decodeURIComponent(other ?? "")} />;
  if (what === "sessions" && id) return <SessionPage key={id} id={id} />;
  if (what === "subjects" && id) return <SubjectPage key={id} code={decodeURIComponent(id)} />;
  if (what === "compare" && id && other) return <ComparePage key={id + other} first={id} second={other} />;
  if (what === "calibrations" && id) return <CalibrationPage key={id} id={id} />;
  if (what === "reports" && id) return <ResultPage key={id} id={id} />;
  return <HomePage />;
}

function App() {
  const place = usePlace();
  const { value: caller, problem, again } = useLoaded(api.caller, "caller");
  if (problem?.status === 401) return <SignInPage onDone={again} problem={problem.code === "key-missing" ? null : problem} />;
  return (
    <>
      <header class="bar">
        <a href="#/" class="brand">
          gonio
        </a>
        <nav aria-label="Main">
          <a href="#/">Sessions</a>
          <a href="/docs">API</a>
        </nav>
        {caller?.signed_in && (
          <button class="quiet" onClick={() => api.signOut().then(again)}>
            Sign out of {caller.lab}
          </button>
        )}
      </header>
      <main>{problem ? <ProblemNote problem={problem} /> : caller && <Page place={place} />}</main>
    </>
  );
}

render(<App />, document.getElementById("app")!);
