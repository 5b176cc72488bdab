package afspm.client;

import java.io.BufferedReader;
import java.io.IOException;
import java.io.InputStreamReader;
import java.nio.charset.StandardCharsets;
import java.util.concurrent.CompletableFuture;
import java.util.concurrent.ExecutionException;
import java.util.concurrent.TimeUnit;
import java.util.concurrent.TimeoutException;
import java.util.function.Consumer;
import java.util.logging.ConsoleHandler;
import java.util.logging.Formatter;
import java.util.logging.LogRecord;

/** Runs a component that {@code afspm run} started. */
public final class Component {
    /** Exit codes: the reason why a process ends, for its supervisor. Every other code is a crash that a restart follows. */
    public static final int DONE = 0;
    public static final int CRASHED = 1;
    /** The settings can't work: a restart would fail the same way. */
    public static final int CONFIG = 78;
    /** The experiment ended. */
    public static final int ENDED = 80;
    /** Standard input has ended. */
    public static final int STOPPED = 81;

    private static final long AFTER_THE_END_MS = 1000; // to handle packets received before it
    private static final long AFTER_A_STOP_MS = 200; // the parent kills a stopped process soon after

    private Component() {
    }

    /** Run a component, and end the process when {@code main} returns, the experiment ends, or standard input does. */
    public static void run(Consumer<Experiment> main) {
        run(main, line -> { }, Experiment.LONGEST_STEP_S);
    }

    /**
     * Run a component, and end the process when {@code main} returns, the experiment ends, or standard input does.
     *
     * @param main what the component does; when it returns, the component is done
     * @param onLine receives further lines of standard input, in its own thread
     * @param longestStepS longest time between two calls, in s; after it the process counts as frozen
     */
    public static void run(Consumer<Experiment> main, Consumer<String> onLine, double longestStepS) {
        logToStandardError();
        BufferedReader input = new BufferedReader(new InputStreamReader(System.in, StandardCharsets.UTF_8));
        int code;
        try {
            String line = input.readLine();
            if (line == null) {
                System.exit(STOPPED);
            }
            try (Experiment experiment = new Experiment(Launch.parse(line), longestStepS)) {
                CompletableFuture<Integer> done = begin(main, experiment);
                thread("standard input", () -> read(input, onLine, experiment));
                code = awaitEnd(experiment, done);
            }
        } catch (AfspmException | IOException error) {
            code = exitCodeOf(error);
        }
        Runtime.getRuntime().halt(code); // nothing is left to do, and a thread of the user may still run
    }

    /**
     * Take part as a component that is no Java program, such as a script of MATLAB or Octave, which can't implement an
     * interface. The process ends by itself when the experiment or standard input does: no call of the script throws
     * {@link ExperimentEndedException} or {@link StopRequestedException}.
     */
    public static Experiment begin() {
        logToStandardError();
        BufferedReader input = new BufferedReader(new InputStreamReader(System.in, StandardCharsets.UTF_8));
        Experiment experiment;
        try {
            String line = input.readLine();
            experiment = new Experiment(Launch.parse(line == null ? "" : line), Experiment.LONGEST_STEP_S);
        } catch (IOException error) {
            throw new ConfigException("standard input has no launch line: " + error);
        }
        // before a call of the script throws: its interpreter would end with the exit code of a crash
        experiment.link().onFail(reason -> Runtime.getRuntime().halt(exitCodeOf(reason)));
        experiment.start();
        thread("standard input", () -> read(input, line -> { }, experiment));
        return experiment;
    }

    private static CompletableFuture<Integer> begin(Consumer<Experiment> main, Experiment experiment) {
        CompletableFuture<Integer> done = new CompletableFuture<>();
        CompletableFuture<Void> begun = new CompletableFuture<>();
        thread("component", () -> {
            try {
                begun.complete(null);
                main.accept(experiment);
                done.complete(DONE);
            } catch (Throwable error) {
                done.complete(exitCodeOf(error));
            }
            experiment.link().change(() -> { });
        });
        begun.join();
        experiment.start();
        return done;
    }

    /** Wait until the component is done or has to end; return the exit code. */
    private static int awaitEnd(Experiment experiment, CompletableFuture<Integer> done) {
        try {
            experiment.link().await(done::isDone, Long.MAX_VALUE);
            return done.join();
        } catch (AfspmException reason) {
            long graceMs = reason instanceof ExperimentEndedException ? AFTER_THE_END_MS : AFTER_A_STOP_MS;
            try {
                done.get(graceMs, TimeUnit.MILLISECONDS);
            } catch (TimeoutException | ExecutionException | InterruptedException late) {
                Link.LOG.fine("the component goes on after the end");
            }
            return exitCodeOf(reason);
        }
    }

    private static void read(BufferedReader input, Consumer<String> onLine, Experiment experiment) {
        try {
            for (String line = input.readLine(); line != null; line = input.readLine()) {
                onLine.accept(line);
            }
        } catch (IOException error) {
            Link.LOG.fine("standard input can't be read: " + error);
        } finally {
            experiment.link().fail(new StopRequestedException("standard input has ended"));
        }
    }

    private static int exitCodeOf(Throwable error) {
        if (error instanceof ExperimentEndedException) {
            return ENDED;
        }
        if (error instanceof StopRequestedException) {
            return STOPPED;
        }
        if (error instanceof ConfigException) {
            Link.LOG.severe(error.getMessage());
            return CONFIG;
        }
        error.printStackTrace();
        return CRASHED;
    }

    private static void thread(String name, Runnable task) {
        Thread thread = new Thread(task, name);
        thread.setDaemon(true);
        thread.start();
    }

    /** Begin each line of the log with its level, which the supervisor reads. */
    private static void logToStandardError() {
        ConsoleHandler handler = new ConsoleHandler();
        handler.setFormatter(new Formatter() {
            @Override
            public String format(LogRecord line) {
                String level = line.getLevel().getName().replace("SEVERE", "ERROR");
                return level + " " + formatMessage(line) + System.lineSeparator();
            }
        });
        Link.LOG.setUseParentHandlers(false);
        Link.LOG.addHandler(handler);
    }
}
