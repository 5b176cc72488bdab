"""AFMBench-Sim: tasks with known truth for agents and algorithms, on the simulated microscope (`afspm bench`).

**Theory of operation.** A generator draws a task from a seed. The bench runs the task's experiment in separate
processes and in a folder that the agent's process can't open (`sealing`), starts the agent once all processes are
ready, and judges record and truth after the end. The agent's report alone proves nothing: a trial counts only if it is
solved, harmless and honest.

    comes in      the public or sealed half of the tasks, the seeds from its key, an agent
    state         one folder for each trial, deleted at the end of the trial unless `--keep` is set
    goes out      one JSON line for each trial, and a page
    always holds  the agent gets sockets, a prompt and a folder of its own, but not the seed of its task, the truth or
                  the experiment file; the same key draws the same tasks

A trial is a real run of processes, sockets and a record on disk, and takes about three seconds of a processor. On the
fake clock of `afspm.testing.components` an agent that waits for a model's server, or for its own threads, would stop
the bench, and its process could not be sealed off. The price: two runs of a seed have the same task and sample, but
other noise. So judges have margins, and generators draw only tasks whose answer is clear.

| module | |
| --- | --- |
| `tasks`, `families/` | generators with their judges |
| `seeds` | the seeds of both halves |
| `trial`, `agent_process`, `session`, `sealing` | one trial |
| `evidence`, `judging` | the verdict |
| `agents/` | baselines and planted agents |
| `cassette` | calls of tools, recorded and replayed |
| `bench`, `page`, `commands` | all trials, the table, `afspm bench` |
"""
