package afspm.client;

import afspm.Control.ControlMode;
import afspm.Control.ControlRequest;
import afspm.Control.ParameterMsg;
import afspm.Control.ScopeState;
import afspm.Feedback.ZCtrlParameters;
import afspm.Journal.Note;
import afspm.Journal.Progress;
import afspm.Journal.Told;
import com.google.gson.Gson;
import com.google.gson.JsonObject;
import com.google.protobuf.ByteString;
import com.google.protobuf.InvalidProtocolBufferException;
import java.nio.charset.StandardCharsets;
import java.util.function.BooleanSupplier;
import java.util.function.Supplier;

/**
 * A running experiment, from the side of one component.
 *
 * <p>Lengths are in metres, angles in radians, times in seconds; other units of parameters are named. Commands
 * request control by themselves and release it; while it is refused or revoked, they wait for it. Every
 * call may throw {@link RefusedException}, {@link NoResponseException}, {@link ControlLostException},
 * {@link ExperimentEndedException} and {@link StopRequestedException}. All methods may be called from any thread.
 */
public final class Experiment implements AutoCloseable {
    /** Default of the longest step, in s; a process in a longer step counts as frozen. */
    public static final double LONGEST_STEP_S = 30;
    private static final double JOINED_WITHIN_S = 5;
    private static final double FOR_EVER = Double.POSITIVE_INFINITY;

    private final Launch launch;
    private final Link link;
    private final ProblemNames problems;
    private final ControlHold control;
    private final Commands commands;
    private final Measurements measurements;
    private final Heartbeat heartbeat;
    private final Publisher publisher;

    /**
     * Take part as described by a launch line; {@link Component#run} and {@link #join} do so.
     *
     * @param longestStepS longest time between two calls, in s; after it the process counts as frozen
     */
    public Experiment(Launch launch, double longestStepS) {
        this.launch = launch;
        problems = new ProblemNames(launch.problems);
        link = new Link(launch);
        control = new ControlHold(link);
        commands = new Commands(link, control);
        measurements = new Measurements(link, control, commands);
        heartbeat = launch.sockets.heartbeat == null ? null : new Heartbeat(launch, link::stepAgeS, longestStepS);
        publisher = launch.sockets.publish == null ? null : new Publisher(launch.sockets.publish, launch.keys);
    }

    /**
     * Join a running experiment.
     *
     * @param where the folder of a run, or of all runs: then the newest one
     * @param name the name shown as the holder of control; different for each program that joins
     */
    public static Experiment join(String where, String name) {
        Experiment experiment = new Experiment(Launch.ofGuest(where, name), LONGEST_STEP_S);
        experiment.start();
        try {
            experiment.awaitReady(JOINED_WITHIN_S);
            return experiment;
        } catch (AfspmException error) {
            experiment.close();
            throw error;
        }
    }

    /** Begin to receive. Queues made by {@link #listen} before this call miss no packet. */
    void start() {
        link.start();
    }

    /** Wait until the scheduler is connected and all packets of its cache have arrived. */
    public void awaitReady(double timeoutS) {
        long deadline = Time.deadline(timeoutS);
        if (launch.sockets.control != null && !link.await(link.requests::isConnected, deadline)) {
            throw new NoResponseException("joining", "the scheduler does not answer; is the experiment running?", Response.NOT_SENT);
        }
        link.awaitCaughtUp(deadline);
    }

    /** Return the launch line of this component: name, settings, folder. */
    public Launch launch() {
        return launch;
    }

    // --- looking ---

    /** Return the state of the microscope, such as "SS_FREE". */
    public String state() {
        return link.state().name();
    }

    public boolean isFree() {
        return link.state() == ScopeState.SS_FREE;
    }

    /** Return mode, holder of control and problems; null before the first packet. */
    public ControlState controlState() {
        return link.control();
    }

    /** Whether this component is in control. */
    public boolean isInControl() {
        return control.isHeld();
    }

    /** Return region and shape of the next scan; null before the first packet. */
    public ScanParameters scanParameters() {
        return link.scanParameters();
    }

    /** Return the feedback; null before the first packet. */
    public ZCtrlParameters feedback() {
        return link.feedback();
    }

    /** Return the position of the probe in metres, as {x, y}; null before the first packet. */
    public double[] probePositionM() {
        return link.probePositionM();
    }

    /** Return a queue of packets published from now on under envelopes with this prefix; "" for all. Close it at the end. */
    public PacketQueue listen(String prefix) {
        return new PacketQueue(link, prefix);
    }

    /** Wait until a condition holds, tested after each published packet; return false at the timeout. */
    public boolean waitUntil(BooleanSupplier condition, double timeoutS) {
        return link.await(condition, Time.deadline(timeoutS));
    }

    /** Wait for the end of the experiment, which throws {@link ExperimentEndedException}. */
    public void untilEnd() {
        link.await(() -> false, Long.MAX_VALUE);
    }

    // --- measuring ---

    /** Take a scan of a region (null: as set) with a number of pixels (0: as set). */
    public ScanSet scan(Region region, int rows, int columns) {
        return scan(region, rows, columns, null, FOR_EVER);
    }

    /** Take a scan once in this run, by its key. */
    public ScanSet scan(Region region, int rows, int columns, String key) {
        return scan(region, rows, columns, key, FOR_EVER);
    }

    /**
     * Take a scan. A scan interrupted by a problem, MANUAL or a restart is repeated once control is granted again.
     *
     * @param region null: as set
     * @param rows 0: as set
     * @param columns 0: as set
     * @param key unique in this run: a component that is killed and restarted gets the scan of its earlier life
     *     instead of a second one; null: no key
     * @param timeoutS in real seconds
     */
    public ScanSet scan(Region region, int rows, int columns, String key, double timeoutS) {
        Target.OfScan target = new Target.OfScan(new ScanParameters(region, rows, columns), launch.sampleCoordinates);
        return new ScanSet(measurements.take(target, key, Time.deadline(timeoutS)));
    }

    /** Move the probe to a position in metres and take a spectrum of a kind such as "IV". */
    public Spectrum spectrum(double xM, double yM, String kind) {
        return spectrum(new double[] {xM, yM}, kind, null, FOR_EVER).spectrum();
    }

    /**
     * Take a spectrum.
     *
     * @param atM position in metres, as {x, y}; null: the present one
     * @param kind such as "IV"; null: as set
     * @param key as of a scan
     * @param timeoutS in real seconds
     */
    public MeasuredSpectrum spectrum(double[] atM, String kind, String key, double timeoutS) {
        Target.OfSpectrum target = new Target.OfSpectrum(atM, kind, launch.sampleCoordinates);
        return new MeasuredSpectrum(measurements.take(target, key, Time.deadline(timeoutS)));
    }

    // --- setting and getting ---

    /** Set a parameter to a number in its SI unit; return the value in force. */
    public double set(String parameter, double value) {
        return set(parameter, value, null);
    }

    /** Set a parameter to a number in {@code unit} (null: SI); return the value in force, in the same unit. */
    public double set(String parameter, double value, String unit) {
        if (Double.isNaN(value) || Double.isInfinite(value)) {
            throw new InvalidValueException(parameter + " can't be set to " + value);
        }
        String text = value == Math.rint(value) && Math.abs(value) < 1e15 ? String.valueOf((long) value) : String.valueOf(value);
        String given = unit == null ? Units.ofParameters().get(parameter) : unit;
        byte[] answer = command(ControlRequest.REQ_PARAM_VALUE, Wire.parameter(parameter, text, given)).object();
        return answer.length == 0 ? value : number(answer, unit);
    }

    /** Set a parameter to a word, such as "up" or "true"; return the value in force. */
    public String setText(String parameter, String value) {
        byte[] answer = command(ControlRequest.REQ_PARAM_VALUE, Wire.parameter(parameter, value, null)).object();
        return answer.length == 0 ? value : parameterIn(answer).getValue();
    }

    /** Return the value of a parameter in its SI unit; that of other than base parameters in the microscope's unit. */
    public double get(String parameter) {
        return get(parameter, null);
    }

    /** Return the value of a parameter in {@code unit} (null: SI). */
    public double get(String parameter, String unit) {
        return number(read(parameter), unit);
    }

    /** Return the value of a parameter as text, without its unit. */
    public String getText(String parameter) {
        return parameterIn(read(parameter)).getValue();
    }

    /** Set the given parts of the z feedback; null parts stay unchanged. */
    public void setFeedback(ZCtrlParameters feedback) {
        command(ControlRequest.REQ_SET_ZCTRL_PARAMS_VALUE, feedback.toByteArray());
    }

    /** Move the probe to (x, y) in metres; return on arrival. */
    public void moveProbe(double xM, double yM) {
        control.hold(() -> {
            commands.set(ControlRequest.REQ_SET_PROBE_POS_VALUE, Wire.place(xM, yM), "ProbePosition", Long.MAX_VALUE);
            return null;
        }, 0, Long.MAX_VALUE);
    }

    /** Perform an action of the microscope, such as "x-pulse". */
    public void action(String name) {
        command(ControlRequest.REQ_ACTION_VALUE, Wire.action(name));
    }

    /** Whether the microscope has an action. */
    public boolean supports(String action) {
        return commands.send(ControlRequest.REQ_ACTION_SUPPORT_VALUE, Wire.action(action), link.requests.nextId(), Long.MAX_VALUE, () -> false).ok();
    }

    // --- control and the experiment ---

    /** Hold control while {@code body} runs: no other component acts between two calls in it, unless control is lost. */
    public <T> T withControl(Supplier<T> body) {
        return control.hold(body, 0, Long.MAX_VALUE);
    }

    /** Hold control while {@code body} runs, to solve a problem: it is granted only while the problem is flagged. */
    public <T> T solving(String problem, Supplier<T> body) {
        return control.hold(body, problems.number(problem), Long.MAX_VALUE);
    }

    /**
     * Request control and keep it until {@link #releaseControl}.
     *
     * @param problem the number of the problem to solve; 0 for none
     * @param timeoutS in real seconds
     */
    public void requestControl(int problem, double timeoutS) {
        control.keep(problem, Time.deadline(timeoutS));
    }

    public void releaseControl() {
        control.giveUp();
    }

    /** Flag a problem: it revokes control until a component clears the problem. */
    public void flag(String problem) {
        order("flagging a problem", ControlRequest.REQ_ADD_EXP_PRBLM_VALUE, problems.number(problem));
    }

    /** Clear a problem; no error if it is not flagged. */
    public void clear(String problem) {
        order("clearing a problem", ControlRequest.REQ_RMV_EXP_PRBLM_VALUE, problems.number(problem));
    }

    public boolean isFlagged(String problem) {
        ControlState state = link.control();
        return state != null && state.problems().contains(problems.number(problem));
    }

    /** Set the mode: in MANUAL no component has control. */
    public void setManual(boolean isManual) {
        order("the mode", ControlRequest.REQ_SET_CONTROL_MODE_VALUE, isManual ? ControlMode.CM_MANUAL_VALUE : ControlMode.CM_AUTOMATED_VALUE);
    }

    /** End the experiment for all, this process included. */
    public void end() {
        link.requests.order("ending the experiment", ControlRequest.REQ_END_EXPERIMENT_VALUE, Requests.NOTHING);
    }

    /** Return the experiment time, ns since the Unix epoch. */
    public long timeNs() {
        return clock().get("now_ns").getAsLong();
    }

    /** Wait for a number of seconds of experiment time. */
    public void sleep(double seconds) {
        long end = timeNs() + (long) (seconds * 1e9);
        for (JsonObject clock = clock(); clock.get("now_ns").getAsLong() < end; clock = clock()) {
            double speed = clock.has("speed") ? clock.get("speed").getAsDouble() : 1;
            link.await(() -> false, Time.deadline((end - clock.get("now_ns").getAsLong()) * 1e-9 / speed));
        }
    }

    /** Write a remark of 1 to 1000 characters into the record of the run. */
    public void note(String text) {
        note(text, null);
    }

    /** Write a remark of 1 to 1000 characters into the record of the run, on a scan. */
    public void note(String text, Scan scan) {
        long nowNs = timeNs();
        boolean isOfScan = scan != null && scan.timeNs() != 0;
        Note.Builder note = Note.newBuilder().setTimestamp(Time.timestamp(isOfScan ? scan.timeNs() : nowNs)).setWho(launch.name)
                .setText(text).setWritten(Time.timestamp(nowNs));
        if (isOfScan) {
            note.setScan(Time.timestamp(scan.timeNs()));
        }
        relay("Note", note.build().toByteString());
    }

    /** Publish the progress of this component, for people. */
    public void progress(long done, long of) {
        relay("Progress", Progress.newBuilder().setTimestamp(Time.timestamp(timeNs())).setName(launch.name).setDone(done).setOf(of)
                .build().toByteString());
    }

    /** Publish a message defined by this component. The envelope is the message's name, or begins with it and an underscore. */
    public void publish(String envelope, byte[] message) {
        if (publisher == null) {
            throw new ConfigException(launch.name + " was given no address to publish on: say what it `publishes`");
        }
        publisher.publish(envelope, message, timeNs());
    }

    /** Send a request for which there is no method, repeated with its id until it is answered. */
    public Response request(int number, byte[] object) {
        return link.requests.ask(number, object, Long.MAX_VALUE);
    }

    /** Write a line into the log of the experiment. */
    public void log(String text) {
        Link.LOG.info(text);
    }

    /** Leave the experiment, and release control. */
    @Override
    public void close() {
        if (launch.sockets.control != null) {
            control.release();
        }
        link.close();
        if (heartbeat != null) {
            heartbeat.close();
        }
        if (publisher != null) {
            publisher.close();
        }
    }

    Link link() {
        return link;
    }

    private Response command(int number, byte[] object) {
        return control.hold(() -> commands.ask(number, object, Long.MAX_VALUE), 0, Long.MAX_VALUE);
    }

    private void order(String what, int number, int object) {
        link.requests.order(what, number, new byte[] {(byte) object});
    }

    private byte[] read(String parameter) {
        Response response = commands.send(ControlRequest.REQ_PARAM_VALUE, Wire.parameter(parameter, null, null), link.requests.nextId(),
                Long.MAX_VALUE, () -> false);
        if (!response.ok()) {
            throw new RefusedException("the parameter " + parameter, response);
        }
        return response.object();
    }

    private JsonObject clock() {
        byte[] answer = link.requests.order("the time", Wire.CLOCK_REQUEST, Requests.NOTHING).object();
        return new Gson().fromJson(new String(answer, StandardCharsets.UTF_8), JsonObject.class);
    }

    private void relay(String message, ByteString payload) {
        byte[] told = Told.newBuilder().setMessage(message).setPayload(payload).build().toByteArray();
        link.requests.order(message, Wire.RELAY_REQUEST, told);
    }

    private static ParameterMsg parameterIn(byte[] bytes) {
        try {
            return ParameterMsg.parseFrom(bytes);
        } catch (InvalidProtocolBufferException error) {
            throw new WireException("no ParameterMsg: " + error.getMessage());
        }
    }

    private static double number(byte[] bytes, String unit) {
        ParameterMsg message = parameterIn(bytes);
        String wanted = unit == null ? Units.ofParameters().get(message.getParameter()) : unit;
        try {
            double value = Double.parseDouble(message.getValue().trim());
            return wanted == null || message.getUnits().isEmpty() ? value : Units.convert(value, message.getUnits(), wanted);
        } catch (NumberFormatException error) {
            throw new InvalidValueException(message.getParameter() + " is '" + message.getValue() + "', no number: use getText");
        }
    }
}
