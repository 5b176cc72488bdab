import { InvalidValue } from "./errors.js";
import { ExperimentProblem } from "./generated/control_pb.js";

/** The problems of an experiment: those of the wire format, and those added by its file. */
export class ProblemNames {
  private readonly numbers = new Map<string, number>();

  constructor(named: Readonly<Record<string, number>>) {
    for (const [name, number] of Object.entries(ExperimentProblem)) if (typeof number === "number" && number) this.numbers.set(plain(name), number);
    for (const [name, number] of Object.entries(named)) this.numbers.set(plain(name), number);
  }

  /** Return the number of a problem given by number or name, such as "tip-shape-changed". Throws InvalidValue. */
  number(problem: string | number): number {
    const number = typeof problem === "number" ? problem : this.numbers.get(plain(problem));
    if (number === undefined || !(number > 0 && number < 256)) throw new InvalidValue(`there is no problem ${problem}; known: ${[...this.numbers.keys()].join(", ")}`);
    return number;
  }

  /** Return the name of a problem, or its number if it has none. */
  name(number: number): string {
    return [...this.numbers].find(([, one]) => one === number)?.[0] ?? `problem ${number}`;
  }
}

/** Return Return "EP_TIP_SHAPE_CHANGED" and "Tip shape changed" as "tip-shape-changed". */
function plain(name: string): string {
  return name.trim().toLowerCase().replace(/[_ ]/g, "-").replace(/^ep-/, "");
}
