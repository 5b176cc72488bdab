package afspm.client;

import afspm.Control.ControlRequest;
import afspm.Control.ScopeState;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.HashMap;
import java.util.HashSet;
import java.util.List;
import java.util.Map;
import java.util.Set;
import java.util.function.BiConsumer;

/** Takes scans and spectra over one link, one at a time and each exactly once, over interruptions and restarts. */
final class Measurements {
    private static final double BEGUN_WITHIN_S = 5; // from the success of the action to its published state
    private static final int MOST_FAILURES = 5; // in a row without a known reason, before a person has to look

    /** A result, and the reasons of interruptions, for a person. */
    static final class Measured<T> {
        final List<T> things;
        final List<String> interruptions;

        Measured(List<T> things, List<String> interruptions) {
            this.things = things;
            this.interruptions = interruptions;
        }
    }

    /** A cycle that receives the scheduler's packets until it is closed. */
    private final class Watch<T> {
        final Cycle<T> cycle;
        private final BiConsumer<Packet, Boolean> listener;

        Watch(Target<T> target, long sinceNs, boolean isResumed) {
            cycle = new Cycle<>(target.busy, sinceNs, isResumed);
            listener = (packet, isScheduler) -> {
                T result = isScheduler ? target.of(packet) : null;
                if (result != null) {
                    cycle.onResult(target.nameOf(result), result, target.fits(result), packet.timeNs());
                } else if (isScheduler && packet.value() instanceof ScopeState) {
                    cycle.onState((ScopeState) packet.value(), packet.timeNs());
                }
            };
            link.listeners.add(listener);
        }

        boolean isOver() {
            synchronized (link) {
                return cycle.outcome() != null;
            }
        }

        boolean isBegun() {
            synchronized (link) {
                return cycle.isBegun();
            }
        }

        void close() {
            link.listeners.remove(listener);
        }
    }

    /** The progress of a measurement. */
    private final class Task<T> {
        final Target<T> target;
        final String key;
        final String stem;
        final long deadline;
        int attempt;
        int failures;
        List<String> interruptions = new ArrayList<>();
        Watch<T> watch;

        Task(Target<T> target, String key, long deadline) {
            this.target = target;
            this.key = key;
            this.stem = key == null ? link.requests.nextId() : link.launch.name + "/key/" + key;
            this.deadline = deadline;
        }

        /** Return the id of the action that starts the measurement: different for each attempt, equal in every life. */
        String id() {
            return stem + "/" + attempt;
        }

        void dropWatch() {
            if (watch != null) {
                watch.close();
            }
            watch = null;
        }
    }

    private final Link link;
    private final ControlHold control;
    private final Commands commands;
    private final KeyedResults results;
    private final Map<String, Set<String>> channels = new HashMap<>();
    private Watch<?> unfinished;
    private String roundedFacts = "";
    private ScanParameters rounded;
    private boolean isBusy;

    Measurements(Link link, ControlHold control, Commands commands) {
        this.link = link;
        this.control = control;
        this.commands = commands;
        this.results = new KeyedResults(link.launch.stateDir, link.launch.name);
        KeyedResults.Intent intent = results.pending();
        if (intent != null) { // follow from the first packet on the measurement that an earlier life requested
            unfinished = new Watch<>(target(intent), intent.sinceNs, true);
        }
    }

    /** Measure until the result is complete; with a key, once in all lives of the component. */
    <T> Measured<T> take(Target<T> target, String key, long deadline) {
        if (key != null) {
            KeyedResults.check(key);
            KeyedResults.Kept kept = results.find(key, target.facts);
            if (kept != null) {
                List<T> things = new ArrayList<>();
                kept.packets.forEach(packet -> things.add(target.of(packet)));
                return new Measured<>(things, kept.interruptions);
            }
        }
        begin();
        Task<T> task = new Task<>(target, key, deadline);
        try {
            link.awaitCaughtUp(deadline); // cached results must not count as new ones
            takeUp(task);
            Map<String, T> found = finish(task);
            channels.put(target.what, new HashSet<>(found.keySet()));
            if (key != null) {
                List<Packet> packets = new ArrayList<>();
                found.values().forEach(thing -> packets.add(target.packetOf(thing)));
                results.fulfil(key, target.facts, packets, task.interruptions);
            }
            return new Measured<>(new ArrayList<>(found.values()), task.interruptions);
        } catch (RuntimeException error) {
            if (key != null && task.watch != null && !task.watch.isOver()) {
                unfinished = task.watch; // its key leads to the result later
                task.watch = null;
            }
            throw error;
        } finally {
            task.dropWatch();
            link.change(() -> isBusy = false);
        }
    }

    private void begin() {
        synchronized (link) {
            if (isBusy) {
                throw new InvalidValueException("a measurement is under way already: one at a time");
            }
            isBusy = true;
        }
    }

    /** Continue this measurement if an earlier life or call had started it. */
    @SuppressWarnings("unchecked") // the facts say that the watch is one for this target
    private <T> void takeUp(Task<T> task) {
        KeyedResults.Intent intent = results.pending();
        Watch<?> watch = unfinished;
        if (task.key == null && watch != null) {
            if (watch.isBegun()) {
                link.await(watch::isOver, task.deadline); // later results belong to another measurement
            }
            watch.close();
            unfinished = watch.isOver() ? watch : null;
            return;
        }
        unfinished = null;
        if (intent == null || !intent.key.equals(task.key) || !intent.facts.equals(task.target.facts)) {
            if (watch != null) {
                watch.close();
            }
            return;
        }
        task.attempt = intent.attempt; // ids of earlier attempts are answered, not executed
        task.interruptions = new ArrayList<>(intent.interruptions);
        task.watch = (Watch<T>) watch;
    }

    private <T> Map<String, T> finish(Task<T> task) {
        Watch<T> watch = task.watch;
        if (watch != null && watch.isBegun()) {
            link.await(watch::isOver, task.deadline);
        }
        if (watch != null && watch.cycle.outcome() == Cycle.Outcome.COMPLETED) {
            control.releaseInherited();
            return watch.cycle.results;
        }
        return control.hold(() -> measure(task), 0, task.deadline).results;
    }

    /** Repeat attempts until one is complete. */
    private <T> Cycle<T> measure(Task<T> task) {
        if (task.watch != null && task.watch.isOver() && task.watch.cycle.outcome() != Cycle.Outcome.COMPLETED) {
            task.dropWatch();
        }
        while (true) {
            Watch<T> watch = task.watch;
            if (watch != null && watch.isOver() && isDone(task, watch.cycle)) {
                return watch.cycle;
            }
            if (watch != null && watch.isOver()) {
                task.dropWatch();
            }
            attempt(task);
        }
    }

    /**
     * Prepare and start once, and follow to the end. A request left unanswered when control was lost, or sent in an earlier
     * life, is repeated with the same id, so that it is not executed twice.
     */
    private <T> void attempt(Task<T> task) {
        control.regain(task.deadline);
        if (task.watch != null && task.watch.isOver()) {
            return; // it had started, and ended during the wait for control
        }
        boolean isNew = task.watch == null;
        if (isNew) {
            task.attempt += 1;
            if (task.key != null) {
                results.intend(intent(task));
            }
        }
        prepare(task.target, task.deadline);
        int states = link.count("ScopeStateMsg");
        if (task.watch == null) {
            task.watch = new Watch<>(task.target, link.newestNs(), false);
        }
        Watch<T> watch = task.watch;
        Response response = commands.send(ControlRequest.REQ_ACTION_VALUE, Wire.action(task.target.start), task.id(), task.deadline, watch::isBegun);
        if (response.ok() || watch.isBegun()) {
            follow(task, watch);
            return;
        }
        if (response.isUnanswered() || (!isNew && response.isNotInControl())) {
            link.change(watch.cycle::controlWasLost); // it may have started
        } else {
            task.dropWatch();
        }
        try {
            commands.getOver(ControlRequest.REQ_ACTION_VALUE, response, states, task.deadline);
        } catch (RefusedException error) {
            if (isNew) {
                throw error;
            } // a request refused to an earlier life needs another id
        }
    }

    /** Follow a measurement from the success of its action to its end. */
    private <T> void follow(Task<T> task, Watch<T> watch) {
        if (!link.awaitConnected(() -> watch.isBegun() || watch.isOver(), BEGUN_WITHIN_S, task.deadline)) {
            link.change(watch.cycle::vanish);
        } else if (!link.await(watch::isOver, task.deadline)) {
            throw new NoResponseException("the " + task.target.what, "it was not finished in time, and goes on", Response.OUTCOME_UNKNOWN);
        }
    }

    /** Whether the result is complete; otherwise note the reason for the next attempt. */
    private <T> boolean isDone(Task<T> task, Cycle<T> cycle) {
        String what = task.target.what;
        Set<String> missing = new HashSet<>(channels.getOrDefault(what, new HashSet<>()));
        missing.removeAll(cycle.results.keySet());
        boolean isCompleted = cycle.outcome() == Cycle.Outcome.COMPLETED;
        if (isCompleted && missing.isEmpty()) {
            return true;
        }
        if (isCompleted) {
            channels.remove(what); // missing again: these channels are no longer recorded
        }
        String why = isCompleted ? "without " + missing + ", which it had before" : whyFailed(cycle);
        task.interruptions.add(why);
        Link.LOG.warning(what + " interrupted: " + why + "; retrying");
        task.failures = control.isHeld() ? task.failures + 1 : 0; // a loss of control is a known reason
        if (task.failures >= MOST_FAILURES) {
            throw new MeasurementFailedException("the " + what + " failed " + task.failures + " times: " + why);
        }
        return false;
    }

    private String whyFailed(Cycle<?> cycle) {
        if (!control.isHeld()) {
            return "control was lost: " + control.whyLost();
        }
        switch (cycle.outcome()) {
            case INTERRUPTED:
                return "something else stopped it";
            case ANOTHER:
                return "not what was asked for was measured; what else sets the microscope?";
            default:
                return "the microscope is free again without a result; was it restarted?";
        }
    }

    /** Set the parameters of a target that differ from those in force. */
    private void prepare(Target<?> target, long deadline) {
        if (target instanceof Target.OfScan) {
            prepareScan((Target.OfScan) target, deadline);
            return;
        }
        Target.OfSpectrum spectrum = (Target.OfSpectrum) target;
        if (spectrum.kind != null) {
            commands.ask(ControlRequest.REQ_PARAM_VALUE, Wire.parameter("x-spec-kind", spectrum.kind, null), deadline);
        }
        if (spectrum.atM != null && !Arrays.equals(spectrum.atM, link.probePositionM())) {
            commands.set(ControlRequest.REQ_SET_PROBE_POS_VALUE, Wire.place(spectrum.atM[0], spectrum.atM[1]), "ProbePosition", deadline);
        }
    }

    private void prepareScan(Target.OfScan target, long deadline) {
        ScanParameters wanted = target.wanted;
        ScanParameters now = link.scanParameters();
        boolean isRounded = roundedFacts.equals(target.facts) && now != null && now.equals(rounded);
        // in sample coordinates the tip position of a region changes with time
        boolean isFixed = !target.moves || wanted.region() == null;
        boolean isNothing = wanted.region() == null && wanted.rows() == 0;
        if (isNothing || (isFixed && (wanted.isSetBy(now, Target.SAME) || isRounded))) {
            return;
        }
        commands.set(ControlRequest.REQ_SET_SCAN_PARAMS_VALUE, wanted.toWire().toByteArray(), "ScanParameters2d", deadline);
        // a controller may round: this is the requested value after rounding
        rounded = link.scanParameters();
        roundedFacts = wanted.isSetBy(rounded, Target.FITS) ? target.facts : "";
    }

    private <T> KeyedResults.Intent intent(Task<T> task) {
        KeyedResults.Intent intent = new KeyedResults.Intent();
        intent.key = task.key;
        intent.facts = task.target.facts;
        intent.attempt = task.attempt;
        intent.sinceNs = link.newestNs();
        intent.interruptions = task.interruptions;
        if (task.target instanceof Target.OfScan) {
            ScanParameters wanted = ((Target.OfScan) (Target<?>) task.target).wanted;
            Region region = wanted.region();
            intent.place = region == null ? null
                    : new double[] {region.xM(), region.yM(), region.widthM(), region.heightM(), region.angleRad()};
            intent.rows = wanted.rows();
            intent.columns = wanted.columns();
        } else {
            intent.place = ((Target.OfSpectrum) (Target<?>) task.target).atM;
            intent.kind = ((Target.OfSpectrum) (Target<?>) task.target).kind;
        }
        return intent;
    }

    private Target<?> target(KeyedResults.Intent intent) {
        boolean moves = link.launch.sampleCoordinates;
        double[] place = intent.place;
        if (!intent.facts.startsWith("scan ")) {
            return new Target.OfSpectrum(place, intent.kind, moves);
        }
        Region region = place == null ? null : new Region(place[0], place[1], place[2], place[3], place[4]);
        return new Target.OfScan(new ScanParameters(region, intent.rows, intent.columns), moves);
    }
}
