package afspm.client;

import static org.junit.jupiter.api.Assertions.assertArrayEquals;
import static org.junit.jupiter.api.Assertions.assertEquals;
import static org.junit.jupiter.api.Assertions.assertTrue;

import com.google.gson.JsonArray;
import com.google.gson.JsonElement;
import com.google.gson.JsonObject;
import com.google.gson.JsonParser;
import com.google.protobuf.Message;
import java.io.IOException;
import java.nio.charset.StandardCharsets;
import java.nio.file.Files;
import java.nio.file.Paths;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.List;
import java.util.stream.Stream;
import org.junit.jupiter.api.DynamicTest;
import org.junit.jupiter.api.Test;
import org.junit.jupiter.api.TestFactory;

class GoldenTest {
    private static final JsonObject GOLDEN = golden();

    @TestFactory
    Stream<DynamicTest> messagesAreEncodedAndDecoded() {
        return each("messages", golden -> {
            Message.Builder builder = JsonMapping.builder(golden.get("type").getAsString());
            Message message = JsonMapping.merge(golden.getAsJsonObject("fields"), builder).build();
            byte[] reference = bytes(golden.get("hex").getAsString());
            assertArrayEquals(reference, message.toByteArray());
            Message decoded = JsonMapping.builder(golden.get("type").getAsString()).mergeFrom(reference).build();
            assertEquals(message, decoded);
            assertEquals(golden.getAsJsonObject("fields"), JsonMapping.json(decoded));
        });
    }

    @TestFactory
    Stream<DynamicTest> requestsAreEncoded() {
        return each("requests", golden -> {
            List<byte[]> frames = frames(golden);
            int number = afspm.Control.ControlRequest.valueOf(golden.get("request").getAsString()).getNumber();
            byte[] object = frames.size() > 1 ? frames.get(1) : new byte[0];
            assertFrames(frames, Wire.request(number, object, ""));
            assertFrames(Arrays.asList(frames.get(0), object, bytes("612f31")), Wire.request(number, object, "a/1"));
        });
    }

    @TestFactory
    Stream<DynamicTest> responsesAreDecodedAndEncoded() {
        return Stream.concat(each("responses", GoldenTest::checkResponse), each("our_responses", GoldenTest::checkResponse));
    }

    @TestFactory
    Stream<DynamicTest> packetsAreDecodedAndEncoded() {
        return each("published", golden -> {
            List<byte[]> frames = frames(golden);
            Packet packet = Packet.decode(frames);
            assertEquals(golden.get("envelope").getAsString(), packet.envelope());
            assertEquals(golden.get("type").getAsString(), packet.message());
            assertFrames(frames, Packet.encode(packet.envelope(), packet.payload(), packet.timeNs()));
        });
    }

    @Test
    void aScanHasItsValuesInTheirOrderAndItsRegionInMetresAndRadians() {
        for (JsonElement golden : GOLDEN.getAsJsonArray("messages")) {
            if (golden.getAsJsonObject().get("name").getAsString().equals("scan 3x2")) {
                byte[] message = bytes(golden.getAsJsonObject().get("hex").getAsString());
                Scan scan = new Packet("Scan2d", message, 1).scan();
                assertArrayEquals(new double[] {0, 1.5, -2.25, 1e-9, 3e300, -0.0}, scan.toArray());
                assertArrayEquals(new double[][] {{0, 1.5, -2.25}, {1e-9, 3e300, -0.0}}, scan.toMatrix());
                assertEquals(1e-9, scan.at(1, 0));
                assertEquals(2e-6, scan.region().widthM(), 1e-18);
                assertEquals(749.5e-9, scan.region().xM(), 1e-18);
                assertEquals(Math.toRadians(12.5), scan.region().angleRad(), 1e-15);
                assertTrue(scan.values().isReadOnly());
            }
        }
    }

    private interface Check {
        void of(JsonObject golden) throws IOException;
    }

    private static Stream<DynamicTest> each(String what, Check check) {
        List<DynamicTest> tests = new ArrayList<>();
        for (JsonElement one : GOLDEN.getAsJsonArray(what)) {
            JsonObject golden = one.getAsJsonObject();
            String name = golden.has("name") ? golden.get("name").getAsString() : golden.get("envelope").getAsString();
            tests.add(DynamicTest.dynamicTest(name, () -> check.of(golden)));
        }
        return tests.stream();
    }

    private static void checkResponse(JsonObject golden) {
        List<byte[]> frames = frames(golden);
        Response response = Response.decode(frames);
        assertEquals(golden.get("response").getAsInt(), response.code());
        assertFrames(frames, response.encode());
        List<byte[]> longer = new ArrayList<>(frames);
        while (longer.size() < 7) {
            longer.add(new byte[0]);
        }
        assertFrames(frames, Response.decode(longer).encode());
    }

    private static void assertFrames(List<byte[]> expected, List<byte[]> came) {
        assertEquals(expected.size(), came.size());
        for (int i = 0; i < expected.size(); i++) {
            assertArrayEquals(expected.get(i), came.get(i));
        }
    }

    private static List<byte[]> frames(JsonObject golden) {
        List<byte[]> frames = new ArrayList<>();
        JsonArray hex = golden.getAsJsonArray("frames");
        hex.forEach(frame -> frames.add(bytes(frame.getAsString())));
        return frames;
    }

    static byte[] bytes(String hex) {
        byte[] bytes = new byte[hex.length() / 2];
        for (int i = 0; i < bytes.length; i++) {
            bytes[i] = (byte) Integer.parseInt(hex.substring(2 * i, 2 * i + 2), 16);
        }
        return bytes;
    }

    private static JsonObject golden() {
        try {
            byte[] text = Files.readAllBytes(Paths.get("..", "..", "proto", "golden.json"));
            return JsonParser.parseString(new String(text, StandardCharsets.UTF_8)).getAsJsonObject();
        } catch (IOException error) {
            throw new AssertionError(error);
        }
    }
}
