package afspm.client;

import afspm.Control.ControlMode;
import afspm.Control.ControlRequest;
import afspm.Control.ControlResponse;
import afspm.Control.ParameterMsg;
import com.google.gson.Gson;
import com.google.gson.GsonBuilder;
import com.google.gson.JsonArray;
import com.google.gson.JsonElement;
import com.google.gson.JsonNull;
import com.google.gson.JsonObject;
import com.google.gson.JsonParser;
import com.google.gson.JsonPrimitive;
import com.google.protobuf.InvalidProtocolBufferException;
import com.google.protobuf.Message;
import java.nio.DoubleBuffer;
import java.util.ArrayList;
import java.util.Base64;
import java.util.List;
import java.util.concurrent.CountDownLatch;

/** The conformance program of this client, which {@code afspm test-client} judges. */
final class Conformance {
    private static final Gson GSON = new GsonBuilder().serializeNulls().create();

    private final Experiment experiment;
    private final PacketQueue packets;

    private Conformance(Experiment experiment) {
        this.experiment = experiment;
        packets = experiment.listen("");
    }

    public static void main(String[] arguments) {
        Conformance[] program = new Conformance[1];
        CountDownLatch isThere = new CountDownLatch(1);
        Component.run(experiment -> {
            program[0] = new Conformance(experiment);
            isThere.countDown();
            experiment.untilEnd();
        }, line -> {
            try {
                isThere.await();
            } catch (InterruptedException error) {
                return;
            }
            Thread thread = new Thread(() -> program[0].answer(JsonParser.parseString(line).getAsJsonObject()), "step");
            thread.setDaemon(true);
            thread.start();
        }, Experiment.LONGEST_STEP_S);
    }

    private void answer(JsonObject step) {
        JsonObject answer = new JsonObject();
        try {
            answer = carryOut(step);
            if (!answer.has("ok")) {
                answer.addProperty("ok", true);
            }
        } catch (RequestException error) {
            answer = refusal(error.code(), error.reason(), error.detail());
        } catch (Exception error) {
            answer.addProperty("ok", false);
            answer.addProperty("error", error.toString());
        }
        answer.add("id", step.get("id"));
        synchronized (System.out) {
            System.out.println(GSON.toJson(answer));
            System.out.flush();
        }
    }

    private JsonObject carryOut(JsonObject step) throws InvalidProtocolBufferException {
        double timeoutS = step.has("timeout_s") ? step.get("timeout_s").getAsDouble() : Double.POSITIVE_INFINITY;
        JsonObject answer = new JsonObject();
        switch (step.get("do").getAsString()) {
            case "ready":
                experiment.awaitReady(Double.POSITIVE_INFINITY);
                return answer;
            case "decode": {
                Message message = JsonMapping.builder(text(step, "message")).mergeFrom(bytes(step.get("bytes"))).build();
                answer.add("fields", JsonMapping.json(message));
                answer.addProperty("bytes", base64(message.toByteArray()));
                return answer;
            }
            case "encode": {
                Message message = JsonMapping.merge(step.getAsJsonObject("fields"), JsonMapping.builder(text(step, "message"))).build();
                answer.addProperty("bytes", base64(message.toByteArray()));
                return answer;
            }
            case "wait": {
                Packet[] found = new Packet[1];
                if (!experiment.waitUntil(() -> (found[0] = packets.pollBeginningWith(text(step, "prefix"))) != null, timeoutS)) {
                    throw new IllegalStateException("no " + text(step, "prefix") + " came in time");
                }
                return facts(found[0]);
            }
            case "request":
                return request(step.get("number").getAsInt(), step.has("object") ? bytes(step.get("object")) : new byte[0]);
            case "request_control":
                experiment.requestControl(step.get("problem").getAsInt(), timeoutS);
                return answer;
            case "release_control":
                experiment.releaseControl();
                return answer;
            case "get_parameter":
                return parameter(text(step, "name"), null, null);
            case "set_parameter":
                return parameter(text(step, "name"), text(step, "value"), text(step, "unit"));
            case "action":
                return request(ControlRequest.REQ_ACTION_VALUE, Wire.action(text(step, "name")));
            case "problem": {
                boolean isSet = step.get("set").getAsBoolean();
                return request(isSet ? ControlRequest.REQ_ADD_EXP_PRBLM_VALUE : ControlRequest.REQ_RMV_EXP_PRBLM_VALUE,
                        new byte[] {step.get("number").getAsByte()});
            }
            case "mode":
                experiment.setManual(text(step, "mode").equals(ControlMode.CM_MANUAL.name()));
                return answer;
            case "scan": {
                JsonArray center = step.getAsJsonArray("center_m");
                JsonArray size = step.getAsJsonArray("size_m");
                JsonArray shape = step.getAsJsonArray("shape");
                Region region = new Region(center.get(0).getAsDouble(), center.get(1).getAsDouble(), size.get(0).getAsDouble(),
                        size.get(1).getAsDouble(), Math.toRadians(step.get("angle_deg").getAsDouble()));
                ScanSet scans = experiment.scan(region, shape.get(0).getAsInt(), shape.get(1).getAsInt(), null, timeoutS);
                JsonArray all = new JsonArray();
                scans.forEach(scan -> all.add(facts(scan.packet())));
                answer.add("scans", all);
                answer.addProperty("interruptions", scans.interruptions().size());
                return answer;
            }
            case "spectrum": {
                JsonArray at = step.getAsJsonArray("position_m");
                double[] atM = {at.get(0).getAsDouble(), at.get(1).getAsDouble()};
                MeasuredSpectrum measured = experiment.spectrum(atM, text(step, "kind"), null, timeoutS);
                JsonArray all = new JsonArray();
                all.add(facts(measured.spectrum().packet()));
                answer.add("spectra", all);
                answer.addProperty("interruptions", measured.interruptions().size());
                return answer;
            }
            case "state": {
                ControlState state = experiment.controlState();
                answer.addProperty("in_control", experiment.isInControl());
                answer.addProperty("holder", state == null || state.holder().isEmpty() ? null : state.holder());
                answer.addProperty("mode", state == null ? "CM_UNDEFINED" : state.mode());
                answer.add("problems", GSON.toJsonTree(state == null ? new ArrayList<>() : state.problems()));
                answer.addProperty("scope_state", experiment.state());
                return answer;
            }
            case "end":
                experiment.end();
                return answer;
            default:
                throw new IllegalArgumentException("no step " + step.get("do"));
        }
    }

    private JsonObject request(int number, byte[] object) {
        Response response = experiment.request(number, object);
        JsonObject answer = refusal(response.code(), response.reason(), response.detail());
        answer.addProperty("ok", response.ok());
        if (response.object().length > 0) {
            answer.addProperty("object", base64(response.object()));
        }
        return answer;
    }

    private JsonObject parameter(String name, String value, String unit) throws InvalidProtocolBufferException {
        JsonObject answer = request(ControlRequest.REQ_PARAM_VALUE, Wire.parameter(name, value, unit));
        if (answer.has("object")) {
            ParameterMsg inForce = ParameterMsg.parseFrom(bytes(answer.get("object")));
            answer.addProperty("value", inForce.getValue());
            answer.addProperty("unit", inForce.hasUnits() ? inForce.getUnits() : null);
        }
        return answer;
    }

    private static JsonObject refusal(int code, String reason, int detail) {
        JsonObject answer = new JsonObject();
        answer.addProperty("ok", false);
        answer.add("response", ControlResponse.forNumber(code) == null ? new JsonPrimitive(code) : new JsonPrimitive(Response.name(code)));
        answer.addProperty("reason", reason);
        answer.addProperty("detail", detail);
        return answer;
    }

    private static JsonObject facts(Packet packet) {
        JsonObject facts = new JsonObject();
        facts.addProperty("envelope", packet.envelope());
        facts.addProperty("message", packet.message());
        facts.addProperty("timestamp_ns", packet.timeNs() == 0 ? null : packet.timeNs());
        if (packet.scan() != null) {
            Scan scan = packet.scan();
            addScan(facts, scan.channel(), scan.unit(), scan.region(), scan.rows(), scan.columns(), scan.values());
        } else if (packet.value() instanceof ScanLines) {
            ScanLines lines = (ScanLines) packet.value();
            addScan(facts, lines.channel(), lines.unit(), lines.parameters().region(), lines.rows(), lines.parameters().columns(), lines.values());
        } else if (packet.spectrum() != null) {
            Spectrum spectrum = packet.spectrum();
            facts.addProperty("kind", spectrum.kind());
            facts.add("names", GSON.toJsonTree(spectrum.names()));
            facts.add("units", GSON.toJsonTree(spectrum.units()));
            facts.add("position_m", spectrum.positionM() == null ? JsonNull.INSTANCE : GSON.toJsonTree(spectrum.positionM()));
            facts.add("shape", GSON.toJsonTree(new int[] {spectrum.points(), spectrum.names().size()}));
            addValues(facts, spectrum.values());
        }
        return facts;
    }

    private static void addScan(JsonObject facts, String channel, String unit, Region region, int rows, int columns, DoubleBuffer values) {
        facts.addProperty("channel", channel);
        facts.addProperty("unit", unit);
        facts.add("center_m", GSON.toJsonTree(new double[] {region.xM(), region.yM()}));
        facts.add("size_m", GSON.toJsonTree(new double[] {region.widthM(), region.heightM()}));
        facts.addProperty("angle_deg", Math.toDegrees(region.angleRad()));
        facts.add("shape", GSON.toJsonTree(new int[] {rows, columns}));
        addValues(facts, values);
    }

    private static void addValues(JsonObject facts, DoubleBuffer values) {
        int count = values.remaining();
        double sum = 0;
        double moment = 0;
        for (int i = 0; i < count; i++) {
            sum += values.get(i);
            moment += i * values.get(i);
        }
        JsonObject found = new JsonObject();
        found.addProperty("count", count);
        found.addProperty("first", count == 0 ? null : values.get(0));
        found.addProperty("last", count == 0 ? null : values.get(count - 1));
        found.addProperty("sum", sum);
        found.addProperty("moment", moment);
        facts.add("values", found);
        facts.addProperty("view", values.isReadOnly() && !values.hasArray()); // a copy would be a buffer of its own
    }

    private static String text(JsonObject step, String key) {
        return step.has(key) && !step.get(key).isJsonNull() ? step.get(key).getAsString() : null;
    }

    private static byte[] bytes(JsonElement base64) {
        return Base64.getDecoder().decode(base64.getAsString());
    }

    private static String base64(byte[] bytes) {
        return Base64.getEncoder().encodeToString(bytes);
    }
}
