/* For the tests: reads byte strings from standard input (length as two bytes, low first; then direction, then the bytes),
 * decodes each with a fresh decoder, writes each message encoded again in hexadecimal, then the number of bad frames. */
#include <stdio.h>
#include "cellpos_wire.h"

int main(void) {
    int low, high, direction;
    while ((low = getchar()) != EOF && (high = getchar()) != EOF && (direction = getchar()) != EOF) {
        cw_decoder decoder = { { 0 }, 0, false, 0 };
        for (int left = low | high << 8; left > 0; left--) {
            int byte = getchar();
            if (byte == EOF) return 1;
            cw_message message;
            if (cw_push(&decoder, (cw_direction)direction, (uint8_t)byte, &message)) {
                uint8_t out[CW_MAX_FRAME];
                size_t length = cw_encode(&message, out, sizeof out);
                for (size_t i = 0; i < length; i++) printf("%02x", out[i]);
                putchar(' ');
            }
        }
        printf("%lu\n", (unsigned long)decoder.bad_frames);
    }
    return 0;
}
